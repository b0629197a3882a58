"""The comments beside the fields of dataclasses become their descriptions in the Python reference."""

from __future__ import annotations

import ast

import griffe


class FieldComments(griffe.Extension):
    """An extension of griffe, which reads the sources for mkdocstrings (mkdocs.yml)."""

    def on_attribute_instance(self, *, node: object, attr: griffe.Attribute, **_: object) -> None:
        if not isinstance(node, ast.AnnAssign) or attr.docstring is not None or attr.lineno is None:
            return
        lines = attr.lines_collection[attr.filepath]
        comments = [lines[attr.lineno - 1].partition("  # ")[2]]
        above = attr.lineno - 2
        while lines[above].strip().startswith("#"):
            comments.insert(0, lines[above].strip().lstrip("# "))
            above -= 1
        if text := " ".join(filter(None, comments)):
            attr.docstring = griffe.Docstring(text, parent=attr)
