"""Kernel constants: instances of ``wp.struct`` classes, filled by the names of their fields."""

from __future__ import annotations

from typing import Any, TypeVar

import warp as wp

Struct = TypeVar("Struct")


def fill(struct: Struct, *sources: Any, **values: Any) -> Struct:
    """Set every field of a kernel struct and return it.

    Args:
        struct: an instance of a ``wp.struct`` class.
        *sources: objects that have fields as attributes of the same name, such as a section of the settings; the first
            one that has an attribute gives its value.
        **values: fields that no source has under that name; they win over the sources.

    Raises:
        TypeError: a field has no value, or a value has no field.
    """
    fields = struct._cls.vars
    unknown = [name for name in values if name not in fields]
    if unknown:
        raise TypeError(f"{type(struct).__name__} has no field {unknown[0]!r}; its fields are {', '.join(fields)}")
    for name in fields:
        if name in values:
            value = values[name]
        else:
            holder = next((source for source in sources if hasattr(source, name)), None)
            if holder is None:
                raise TypeError(f"{type(struct).__name__}.{name} has no value; give {name}=... or a source that has it")
            value = getattr(holder, name)
        setattr(struct, name, value)
    return struct


def make_struct(struct: wp.Struct, **arrays: wp.array):
    """Return an instance of ``struct`` with these arrays as its members."""
    instance = struct()
    for name, array in arrays.items():
        setattr(instance, name, array)
    return instance
