"""The display and its viewer as a 3D scene: panels, eyes with their uncertainty, rays, the viewing range.

All is in the frame `stack` (x to the viewer, y to the right as the viewer sees it, z up); the sensor's frame is a
transform away from it.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from runtime.blackbox.messages import packed, stamp
from runtime.config import CalibrationSettings
from runtime.optics.stack import PanelStack
from runtime.records import F64

EYE_M = 0.024  # diameter of an eye
SIGMAS = 2.0  # the ball of uncertainty is so many standard deviations in radius
PANEL_M = 0.001  # thickness that a panel is drawn with
NO_TURN = {"x": 0.0, "y": 0.0, "z": 0.0, "w": 1.0}
FOREVER = {"sec": 0, "nsec": 0}
COLOURS = {"left": (0.1, 0.45, 0.9, 1.0), "right": (0.9, 0.35, 0.1, 1.0), "raw": (0.5, 0.5, 0.5, 0.8)}


def transforms(stack: PanelStack, *, stack_from_sensor: F64, wall_ns: int) -> bytes:
    """Where the sensor and every panel are."""
    from scipy.spatial.transform import Rotation

    left = stack_from_sensor[:3, :3]
    x, y, z, w = Rotation.from_matrix(left / np.cbrt(np.linalg.det(left))).as_quat().tolist()
    turned = {"x": x, "y": y, "z": z, "w": w}
    frames = [("sensor", stack_from_sensor[:3, 3].tolist(), turned)]
    frames += [(f"panel-{n}", [x_m, 0.0, 0.0], NO_TURN) for n, x_m in enumerate(stack.x_m)]
    return packed(
        {
            "transforms": [
                {
                    "timestamp": stamp(wall_ns),
                    "parent_frame_id": "stack",
                    "child_frame_id": name,
                    "translation": _vector(place),
                    "rotation": turn,
                }
                for name, place, turn in frames
            ]
        }
    )


def standing(stack: PanelStack, viewing: CalibrationSettings, *, wall_ns: int) -> bytes:
    """What never moves: the panels, and where viewers are meant to be."""
    panels = _entity(
        "panels",
        wall_ns,
        cubes=[
            {
                "pose": {"position": _vector([x_m, 0.0, 0.0]), "orientation": NO_TURN},
                "size": _vector([PANEL_M, stack.width_m, stack.height_m]),
                "color": _colour((0.3, 0.5, 0.7, 0.25)),
            }
            for x_m in stack.x_m
        ],
    )
    edge = [_vector(point) for point in viewing_outline(viewing)]
    return packed(
        {"deletions": [], "entities": [panels, _entity("viewing range", wall_ns, lines=[_line(edge, loop=True)])]}
    )


def viewing_outline(viewing: CalibrationSettings) -> list[list[float]]:
    """The viewing range from above, in the plane z = 0: points (x, y, z) of its edge."""
    (near_m, far_m), side = viewing.viewing_m, math.radians(viewing.viewing_side_deg)
    angles = [side * (k / 4 - 1.0) for k in range(9)]
    near = [[near_m * math.cos(a), near_m * math.sin(a), 0.0] for a in angles]
    far = [[far_m * math.cos(a), far_m * math.sin(a), 0.0] for a in reversed(angles)]
    return near + far


def moving(stack: PanelStack, *, eyes_m: F64 | None, sigma_m: float, wall_ns: int) -> bytes:
    """The eyes at the light, how sure they are, and their rays through the panels' corners."""
    if eyes_m is None:
        gone = [{"timestamp": stamp(wall_ns), "type": 0, "id": name} for name in ("eyes", "rays")]
        return packed({"deletions": gone, "entities": []})
    named = list(zip(("left", "right"), eyes_m.tolist(), strict=True))
    balls = [_ball(place, EYE_M, COLOURS[side]) for side, place in named]
    balls += [_ball(place, EYE_M + 2 * SIGMAS * sigma_m, (*COLOURS[side][:3], 0.25)) for side, place in named]
    half_m = (stack.width_m / 2, stack.height_m / 2)
    corners = [[stack.x_m[0], y * half_m[0], z * half_m[1]] for y in (-1, 1) for z in (-1, 1)]
    rays = [
        _line([_vector(place), _vector(corner)], colour=(*COLOURS[side][:3], 0.5))
        for side, place in named
        for corner in corners
    ]
    return packed(
        {"deletions": [], "entities": [_entity("eyes", wall_ns, spheres=balls), _entity("rays", wall_ns, lines=rays)]}
    )


def measured(points_m: F64 | None, *, wall_ns: int) -> bytes:
    """The eyes as the sensor measured them, in its frame; None: no face."""
    if points_m is None or not np.isfinite(points_m).all():
        return packed({"deletions": [{"timestamp": stamp(wall_ns), "type": 0, "id": "measured"}], "entities": []})
    balls = [_ball(place, EYE_M / 2, COLOURS["raw"]) for place in points_m.tolist()]
    return packed({"deletions": [], "entities": [_entity("measured", wall_ns, frame_id="sensor", spheres=balls)]})


def _entity(name: str, wall_ns: int, *, frame_id: str = "stack", **shapes: list[Any]) -> dict[str, Any]:
    kinds = ("arrows", "cubes", "spheres", "cylinders", "lines", "triangles", "texts", "models")
    return {
        "timestamp": stamp(wall_ns),
        "frame_id": frame_id,
        "id": name,
        "lifetime": FOREVER,
        "frame_locked": True,
        "metadata": [],
        **{kind: shapes.get(kind, []) for kind in kinds},
    }


def _ball(place: list[float], size_m: float, colour: tuple[float, float, float, float]) -> dict[str, Any]:
    return {
        "pose": {"position": _vector(place), "orientation": NO_TURN},
        "size": _vector([size_m] * 3),
        "color": _colour(colour),
    }


def _line(
    points: list[dict[str, float]],
    *,
    loop: bool = False,
    colour: tuple[float, float, float, float] = (0.2, 0.7, 0.3, 0.9),
) -> dict[str, Any]:
    return {
        "type": 1 if loop else 0,
        "pose": {"position": _vector([0.0, 0.0, 0.0]), "orientation": NO_TURN},
        "thickness": 1.0,
        "scale_invariant": True,
        "points": points,
        "color": _colour(colour),
        "colors": [],
        "indices": [],
    }


def _vector(place: list[float]) -> dict[str, float]:
    return {"x": place[0], "y": place[1], "z": place[2]}


def _colour(rgba: tuple[float, float, float, float]) -> dict[str, float]:
    return dict(zip("rgba", rgba, strict=True))
