"""What every method's options share: values out of range are refused by name."""

from __future__ import annotations


def require(options: object, **good: bool) -> None:
    """Refuse options out of range.

    Raises
    ------
    ValueError
        Names the first option that isn't good, and its value.
    """
    for name, right in good.items():
        if not right:
            raise ValueError(f"{name} = {getattr(options, name)}: out of range")
