"""How well a hiding works."""

from keyss.measure.hiding import measure_hiding

__all__ = ["measure_hiding"]
