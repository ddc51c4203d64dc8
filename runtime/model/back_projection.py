"""What the rays of a picture lack of it, once layers are there, added to what the next layers are made for.

A picture is put on the centre panel's pixels, but the rays of its own pixels cross the panels anywhere between those.
What is lost on the way, by one interpolation in and three out, is seen by looking along these rays, and brought
back to the panel's pixels (iterative back-projection: Irani and Peleg 1991).
"""

from __future__ import annotations

import numpy as np

from runtime.model.loops import inner_loops
from runtime.model.pyramid_level import OUTER, spreads
from runtime.optics.retina import layer_from_image, sample_bilinear, seen_by
from runtime.optics.stack import PanelStack, PlaneRaster
from runtime.optics.views import image_from_raster, image_from_stack
from runtime.records import F64, U8

ROUNDING = 1.0  # codes, that the layers' own rounding makes an eye lack: what follows it finds another rounding
MOST = 12.0  # codes: where an eye lacks much more, no layers show it, and to strive for it costs its neighbours
CENTRES = np.array([[1.0, 0.0, 0.5], [0.0, 1.0, 0.5], [0.0, 0.0, 1.0]])  # pixels of integer centres, as continuous ones


def gain_for(stack: PanelStack, eyes_m: F64, *, eye_sigma_mm: float) -> float:
    """How much of what is lacked is added for eyes (2, 3) that err by so much: all for eyes that are sure.

    What moves by more than a pixel as the eyes err is not seen in the mean.
    """
    panels = [stack.panel(n) for n in range(stack.count)]
    felt = spreads(panels, eyes_m, eye_sigma_mm=eye_sigma_mm, least_px=0.0)
    return 1 / (1 + 2 * max(max(felt[n]) for n in OUTER) ** 2)


def add_what_is_lacked(
    image: U8,
    raster: PlaneRaster,
    layers: U8,
    picture: U8,
    stack: PanelStack,
    *,
    eye_m: F64,
    fov_deg: float,
    gain: float,
    rows: slice,
    columns: slice,
) -> None:
    """To rows and columns of `image` (h, w, 4), an eye's picture on a raster of the centre panel, `gain` times what its
    own rays lack of it, beyond what rounding may make, and no more than layers may mend.

    layers: (3, H, W, 4), made for `image`. picture: (rows, columns, 4), `fov_deg` wide. Rays that don't cross every
    panel half a pixel inside its edge lack nothing.
    """
    height, width = picture.shape[:2]
    projection = image_from_stack(eye_m, width_px=width, height_px=height, fov_deg=fov_deg)
    picture_from_raster = _between_centres(image_from_raster(projection, raster))
    picture_from_raster /= picture_from_raster[2] @ (raster.width_px / 2, raster.height_px / 2, 1.0)
    if inner_loops().compiled:
        from runtime.model.compiled.sight import add_at_raster, lack_at_rays  # noqa: PLC0415 - imports numba

        matrices = np.stack([_between_centres(layer_from_image(stack, n, eye_m, projection)) for n in range(3)])
        matrices /= (matrices[:, 2] @ (width / 2, height / 2, 1.0))[:, None, None]
        lack = lack_at_rays(layers, picture, matrices, least=ROUNDING, most=MOST)
        add_at_raster(image, lack, picture_from_raster, gain=gain, rows=rows, columns=columns)
        return
    seen = seen_by(eye_m, layers, stack, fov_deg=fov_deg, width_px=width, height_px=height)
    lacked = (picture[..., :3] - 255 * seen.image) * seen.mask[..., None]
    lacked = np.clip(lacked - np.clip(lacked, -ROUNDING, ROUNDING), -MOST, MOST)
    v, u = np.mgrid[rows, columns]
    x, y, w = (row[0] * u + row[1] * v + row[2] for row in picture_from_raster)
    with np.errstate(divide="ignore", invalid="ignore"):
        x, y = x / w, y / w
    inside = (w > 0) & (x >= 0) & (x <= width - 1) & (y >= 0) & (y <= height - 1)
    back = sample_bilinear(lacked, u=(x + 0.5).astype(np.float32), v=(y + 0.5).astype(np.float32))
    part = image[rows, columns, :3]
    part[...] = np.clip(np.rint(part + gain * inside[..., None] * back), 0, 255)


def _between_centres(matrix: F64) -> F64:
    """3x3 between pixels whose centres are at integers, from one between those whose centres are at halves."""
    return np.asarray(np.linalg.inv(CENTRES) @ matrix @ CENTRES, np.float64)
