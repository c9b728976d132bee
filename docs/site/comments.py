"""An extension of griffe, which reads the docstrings: a field that has none has the comment behind it."""

import re
from typing import Any

import griffe


class Comments(griffe.Extension):
    """Fields that a line says enough about are explained by a comment on that line."""

    def on_attribute_instance(self, *, attr: griffe.Attribute, **_: Any) -> None:
        """Take the comment as docstring."""
        if attr.docstring is None and attr.endlineno and attr.parent and attr.parent.is_class:
            line = attr.lines_collection[attr.filepath][attr.endlineno - 1]
            if comment := re.search(r"  # (?!noqa|pyright)(.*)", line):
                attr.docstring = griffe.Docstring(comment[1][:1].upper() + comment[1][1:] + ".", parent=attr)
