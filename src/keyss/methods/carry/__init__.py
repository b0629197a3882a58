"""Carrying: a model inside the low bits of another, without training and nearly without loss."""

from keyss.methods.carry.carrying import Carried, embed, extract

__all__ = ["Carried", "embed", "extract"]
