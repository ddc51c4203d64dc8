"""Geometry of a display, for programs."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import fields

from runtime.config import StackGeometry, validated
from runtime.errors import InputError
from runtime.optics.stack import PanelStack, Tilt


class Stack(PanelStack):
    """Parallel panels of one size, rear to front at `x_m` (metres), centred on the origin."""

    __slots__ = ()

    def __init__(
        self,
        width_m: float,
        height_m: float,
        x_m: Sequence[float],
        width_px: int,
        height_px: int,
        tilt: Tilt | None = None,
    ) -> None:
        """Raise ValueError, naming the argument, if the display is impossible."""
        given = {"width_m": width_m, "height_m": height_m, "width_px": width_px, "height_px": height_px}
        try:
            places = tuple(float(x) for x in x_m)
        except (TypeError, ValueError):
            raise ValueError(f"x_m: must list the panels' positions, such as (-0.03, 0.0, 0.03), not {x_m!r}") from None
        try:
            checked = validated(StackGeometry, {**given, "x_m": places}, source="")
        except InputError as error:
            raise ValueError(str(error)) from None
        super().__init__(checked.width_m, checked.height_m, checked.x_m, checked.width_px, checked.height_px, tilt)


def checked_stack(stack: object) -> PanelStack:
    """Return a plain copy of a stack. Raises ValueError for anything else."""
    if not isinstance(stack, PanelStack):
        raise ValueError(f"stack: must be a phasestack.Stack, not {type(stack).__name__}")
    return PanelStack(*(getattr(stack, field.name) for field in fields(PanelStack)))
