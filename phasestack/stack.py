"""A display's geometry, with validated arguments."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import fields

from phasestack.pictures import as_numbers
from runtime.config import StackGeometry, validated
from runtime.errors import InputError
from runtime.optics.stack import PanelStack, Tilt


class Stack(PanelStack):
    """Geometry of a display whose parallel panels are all the same size and centred on the x axis.

    Attributes:
        width_m: Width of a panel's picture area in metres.
        height_m: Height of a panel's picture area in metres.
        x_m: The panels' positions along the x axis in metres, ascending from the rear panel to the front panel.
        width_px: Number of pixel columns on each panel.
        height_px: Number of pixel rows on each panel.
        tilt: The panels' deviation from parallel planes, as measured by a calibration.
        colour: For each panel, True if it has colour filters. Empty if all panels have.
    """

    __slots__ = ()

    def __init__(
        self,
        width_m: float,
        height_m: float,
        x_m: Sequence[float],
        width_px: int,
        height_px: int,
        tilt: Tilt | None = None,
        colour: Sequence[bool] = (),
    ) -> None:
        """Validate the geometry. Raises ValueError if an argument is invalid, naming the argument."""
        given = {"width_m": width_m, "height_m": height_m, "width_px": width_px, "height_px": height_px}
        try:
            places = tuple(map(float, as_numbers("x_m", list(x_m), "")))
        except (TypeError, ValueError):
            raise ValueError(f"x_m: must list the panels' positions, such as (-0.03, 0.0, 0.03), not {x_m!r}") from None
        try:
            checked = validated(StackGeometry, {**given, "x_m": places, "colour": tuple(colour)}, source="")
        except InputError as error:
            raise ValueError(str(error)) from None
        super().__init__(
            checked.width_m,
            checked.height_m,
            checked.x_m,
            checked.width_px,
            checked.height_px,
            tilt,
            checked.stack().colour,
        )


def checked_stack(stack: object) -> PanelStack:
    """Return a stack as a plain `PanelStack`. Raises ValueError if the argument is not a stack."""
    if not isinstance(stack, PanelStack):
        raise ValueError(f"stack: must be a phasestack.Stack, not {type(stack).__name__}")
    return PanelStack(*(getattr(stack, field.name) for field in fields(PanelStack)))
