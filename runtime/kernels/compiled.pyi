"""The compiled module (binding.cpp). Arrays are neither converted nor copied: another dtype is a TypeError.

Functions raise ValueError for shapes and values that do not fit, and MemoryError. Any thread may call them; what one
object does at a time is up to the caller. The parts of a problem may run on several threads.
"""

from collections.abc import Sequence

from numpy import float32, float64, int16, int32, uint8, uint32
from numpy.typing import NDArray

INTERFACE: int
MAX_PANELS: int
MAX_SETS: int

def levels() -> list[int]:
    """Return the x86-64 levels that the loops are compiled for and this processor has, the best (in use) first."""

def use_level(level: int) -> None:
    """Use another level. For tests and measurements."""

class Panels:
    """The panels' values between steps, in sixteenths of a code. Each panel's box starts at the first pixel."""

    def __init__(self, count: int, rows: int, columns: int, channels: int) -> None: ...
    def set(self, panel: int, values: NDArray[int16]) -> None:
        """Set a box to (rows, columns[, 3]) values."""

    def fill(self, panel: int, rows: int, columns: int, value: int) -> None: ...
    def values(self, panel: int, rows: int, columns: int) -> NDArray[int16]:
        """Return a copy of a box, (rows, columns, channels)."""

    def start(self) -> None:
        """Let the next step begin without momentum."""

    def advance(self) -> None:
        """Make a step's result the panels' values, once all its parts are done."""

    def write(self, panel: int, row: int, column: int, pixels: NDArray[uint8], begin: int, end: int) -> None:
        """Write rows `begin` to `end` - 1 of (rows, columns, 4) RGBA pixels, whose first is a panel's (row, column)."""

class Rays:
    """The rays of one solution. Holds the pictures."""

    def __init__(
        self,
        pictures: Sequence[NDArray[uint8]],  # for each view, (rows, columns) or (rows, columns, 3); rows may be apart
        column_taper: NDArray[int16],  # (columns,) weights for the rays' errors; 32767 stands for 1
        row_taper: NDArray[int16],  # (rows,) further weights
        table: NDArray[int32],  # (256,) for each code, the sum of panel values plus 65536 times the weight
        rest: float,  # value outside the panels, to close the middle panel
        missing: float,  # weight for rays that miss a panel, to close the middle panel
    ) -> None: ...

class Problem:
    """Ray sets through the panels' boxes, for one step or to close the middle panel. Holds the panels and the rays."""

    def __init__(
        self,
        panels: Panels,
        rays: Rays,
        closing: bool,
        boxes: Sequence[tuple[int, int]],  # rows and columns, for each panel
        panels_from_rays: NDArray[float64],  # (sets, panels, 3, 3) homographies
        rays_from_panels: NDArray[float64],  # (sets, panels, 3, 3) their inverses
        sets: Sequence[tuple[int, int]],  # view and turn of each set
        turns: int,  # row r of a set is row r * turns + turn of its view's picture
        grey: Sequence[bool],  # for each panel, True if it has one value for all channels
    ) -> None: ...
    def close_middle(self, part: int, parts: int) -> None:
        """Solve one of `parts` parts of the middle panel with the other panels held fixed."""

    def step(self, size: float, momentum: float, floor: float, part: int, parts: int) -> None:
        """Do one of `parts` parts of a step."""

class Source:
    """A copy of an (h, w[, 3]) image whose values are limited to +-8160, to be resampled."""

    def __init__(self, image: NDArray[int16]) -> None: ...
    def warp(
        self,
        result: NDArray[int16],  # (rows, columns[, 3])
        image_from_raster: NDArray[float64],  # (3, 3) homography
        image_law: tuple[float, float],  # bend and middle of the column laws
        raster_law: tuple[float, float],
        reach_px: float,
        outside: int,
        rows: tuple[int, int],  # the first row to compute, and the first not to
    ) -> None: ...

def squared_error(
    layers: NDArray[uint8],  # (panels, rows, columns, 3 or 4)
    target: NDArray[float32],  # (rows, columns, 3)
    centre_from_image: NDArray[float64],  # (3, 3)
    panels_from_centre: NDArray[float64],  # (points, panels, 3, 3)
    toward: NDArray[float64],  # (3,)
    table: NDArray[float32],  # intensity for each sum of codes, or for each 1 / TABLE_STEPS of one if `rays` is 0
    rays: tuple[int, int],  # number of the first ray; rays along a pixel's side
    step: int,
    rows: tuple[int, int],
) -> tuple[float, int]:
    """Return the sum of squared errors over rows of the target, and the number of terms."""

class PanelPicture:
    """A picture that the processor draws on a panel's screen. Holds the arrays, of which `screen` is written.

    Maps are scales across and down, and shifts. Positions in pictures count from the centre of the top left pixel,
    positions on the screen and the panel from their corners.
    """

    def __init__(
        self,
        source: NDArray[uint8],  # (rows, columns, 4) RGBA; positions outside it are moved to its edge
        screen: NDArray[uint8],  # (rows, columns, 4) BGRX
        source_from_panel: tuple[float, float, float, float],
        panel_from_screen: NDArray[float64] | None,  # (3, 3); None if their pixels coincide
        panel_px: tuple[int, int],  # rows and columns, outside which a registered panel's screen shows 0
        relief: NDArray[float32] | None,  # (rows, columns)
        relief_from_screen: tuple[float, float, float, float],  # from the panel's pixels if it is registered
        push: tuple[float, float, float, float],  # displacement in the source's pixels by a relief of 1, on the panel
        flat: NDArray[uint8] | None,  # the screen's size, to be mixed in
        flatness: float,  # its weight, from 0 to 1
        curve: NDArray[uint32] | None,  # (3, 1024) grey curve: one byte for each quarter of a code, blue, green and red
        every: int,  # 1, or 2 to sample every other pixel of every other row and average between; not with `flat`
    ) -> None: ...

def draw_panels(pictures: Sequence[PanelPicture], threads: int) -> None:
    """Draw pictures on several threads with the caller's priority."""

def frame_picture(
    turned: NDArray[uint8],  # (rows, columns, 4), with any strides
    framed: NDArray[uint8],  # larger by the border
    border_px: int,
    extended_px: int,  # 1: the innermost pixel of the border repeats the picture's edge
) -> tuple[int, int, int, int]:
    """Copy a turned picture into the middle of one with a border, and return the box (left, top, right, bottom in the
    framed picture) of the pixels that differ from the border in colour. Without a border, the box is meaningless.
    """

class OutlinedPart:
    """A part's edges (`runtime.content.fringe.Edges`) and vertices. Holds the arrays."""

    def __init__(
        self,
        vertices: NDArray[float32],  # (v, 12)
        faces: NDArray[int32],
        ends: NDArray[int32],
        apex: NDArray[int32],
        normals: NDArray[float64],
        heights: NDArray[float64],
    ) -> None: ...
    def ramps(
        self,
        eye: NDArray[float64],  # (3,) in the part's frame
        clip_from_part: NDArray[float64],  # (4, 4)
        size_px: tuple[int, int],  # the raster's width and height
        ramp_px: float,
        ramps: NDArray[float32],  # (n, 4, 14), written from number `first` on
        first: int,
    ) -> int:
        """Write the ramps along the part's outline, and return how many there are."""
