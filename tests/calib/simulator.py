"""Simulates photographs of a misaligned stack, or only their points where pictures would take too long.

A photograph adds the panels' phases along every ray, each panel at its true place; the intensity is sin² of the sum
(EyeReal, (7)). The lens is a pinhole that darkens the corners, the sensor adds shot and read noise.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np
from scipy.spatial.transform import Rotation

from calib.board import boards, marks
from calib.detect_marks import SeenMarks
from calib.placed import PlacedPanel, corner_pixels, stack_from_pixels, through
from calib.registration import Registration, homographies
from runtime.optics.malus import intensity_from_phase
from runtime.optics.stack import PanelStack
from runtime.records import F64, U8

SAMPLES = 3  # per axis and pixel of the camera
BLUR_PX = 0.7  # standard deviation: lens and focus
ELECTRONS, READ_NOISE = 4000.0, 0.003  # at full scale: shot noise; of full scale
VIGNETTING = 0.3  # loss of light in the corners
GAMMA = 2.2  # of the camera's tone curve
HALF_WIDTH_95 = 1.959964


def ideal_panel(stack: PanelStack, index: int) -> PlacedPanel:
    """A panel that is parallel to the others and centred on the stack's axis."""
    return PlacedPanel(np.eye(3), np.array([stack.x_m[index], 0.0, 0.0]))


@dataclass(frozen=True, slots=True)
class Camera:
    """A pinhole camera; pixel centres at whole numbers."""

    width_px: int = 2400
    height_px: int = 1800
    focal_px: float = 1830.0
    gain: float = 0.8  # of full scale, white in the middle of the picture
    dark: float = 0.01  # light through crossed polarizers, of full scale

    @property
    def matrix(self) -> F64:
        """(3, 3) intrinsic matrix."""
        u, v = (self.width_px - 1) / 2, (self.height_px - 1) / 2
        return np.array([[self.focal_px, 0.0, u], [0.0, self.focal_px, v], [0.0, 0.0, 1.0]])


def photograph(
    phases: U8, panels: Sequence[PlacedPanel], stack: PanelStack, camera: Camera, pose: F64, random: np.random.Generator
) -> U8:
    """Photograph (h, w) by a camera at `pose` (4, 4; camera_from_stack) of panels with 8-bit codes (N, H, W)."""
    size = (SAMPLES * camera.width_px, SAMPLES * camera.height_px)
    middle = np.array([[1.0, 0.0, 0.5], [0.0, 1.0, 0.5], [0.0, 0.0, 1.0]])  # a pixel's centre from its index
    fine = np.diag([SAMPLES, SAMPLES, 1.0])
    fine[:2, 2] = (SAMPLES - 1) / 2
    total = np.zeros(size[::-1], np.uint16)
    for panel, layer in zip(panels, phases, strict=True):
        places = pose[:3, :3] @ stack_from_pixels(panel, stack) + np.outer(pose[:3, 3], [0.0, 0.0, 1.0])
        total += cv2.warpPerspective(layer, fine @ camera.matrix @ places @ middle, size, flags=cv2.INTER_NEAREST)
    light_of = camera.dark + intensity_from_phase(np.arange(255 * len(phases) + 1) / 255)
    size = (camera.width_px, camera.height_px)
    light = cv2.GaussianBlur(cv2.resize(light_of.astype(np.float32)[total], size, interpolation=cv2.INTER_AREA),
                             (0, 0), BLUR_PX)  # fmt: skip
    v, u = np.meshgrid(*(np.linspace(-0.5, 0.5, length) for length in light.shape), indexing="ij")
    light = camera.gain * light * (1 - 2 * VIGNETTING * (u * u + v * v))
    light += random.normal(size=light.shape) * np.sqrt(np.maximum(light, 0) / ELECTRONS + READ_NOISE**2)
    return np.asarray(np.rint(255 * np.clip(light, 0, 1) ** (1 / GAMMA)), dtype=np.uint8)


def camera_from_stack(place_m: F64, *, towards_m: F64, roll_rad: float = 0.0) -> F64:
    """(4, 4) pose of a camera (x right, y down, z away) at a place of `stack` that looks towards a point."""
    away = np.asarray(towards_m, dtype=np.float64) - place_m
    away /= np.linalg.norm(away)
    right = np.cross(away, [0.0, 0.0, 1.0])
    right /= np.linalg.norm(right)
    rotation = Rotation.from_rotvec([0.0, 0.0, roll_rad]).as_matrix() @ [right, np.cross(away, right), away]
    pose = np.eye(4)
    pose[:3, :3], pose[:3, 3] = rotation, -rotation @ place_m
    return pose


def by_hand(count: int, stack: PanelStack, *, random: np.random.Generator) -> list[F64]:
    """`count` poses (4, 4) of a hand-held camera round a display, as `docs/setup.md` requests.

    They cycle through the middle, the left, the right, above and below; some have the camera on its side; the panel
    fills most of the picture.
    """
    directions = [(0, 0), (-32, 4), (32, 4), (0, 24), (0, -22), (-22, 20), (22, 20), (-22, -18), (22, -18), (-38, 0),
                  (38, 0), (12, -26)]  # fmt: skip
    poses = []
    for number in range(count):
        aside, up = np.radians(np.array(directions[number % len(directions)]) + random.normal(scale=4.0, size=2))
        toward = np.array([np.cos(up) * np.cos(aside), np.cos(up) * np.sin(aside), np.sin(up)])
        target = np.array([0.0, *random.normal(scale=0.04 * stack.width_m, size=2)])
        roll = random.normal(scale=np.radians(4.0)) + (np.pi / 2 if number % 4 == 3 else 0.0)
        place = toward * random.uniform(0.95, 1.35) * stack.width_m
        poses.append(camera_from_stack(place, towards_m=target, roll_rad=roll))
    return poses


def misplaced(
    stack: PanelStack, *, shift_m: float, turn_deg: float, gap_m: float, random: np.random.Generator
) -> tuple[PlacedPanel, ...]:
    """A stack as hands build it: every panel off to the side and up by up to `shift_m`, turned about a random axis
    by up to `turn_deg`, every gap off by up to `gap_m`."""
    panels, x_m = [], stack.x_m[0]
    for index in range(stack.count):
        if index:
            x_m += stack.x_m[index] - stack.x_m[index - 1] + random.uniform(-gap_m, gap_m)
        axis = random.normal(size=3)
        turn = Rotation.from_rotvec(axis / np.linalg.norm(axis) * np.radians(turn_deg) * random.uniform())
        centre = np.array([x_m, *random.uniform(-shift_m, shift_m, size=2)])
        panels.append(PlacedPanel(turn.as_matrix(), centre))
    return tuple(panels)


@dataclass(frozen=True)
class Errors:
    """Errors of a registration, in the frame of the reference panel."""

    pixels: np.ndarray  # (K,) distance over an even grid of points of every panel but the reference
    gap_m: np.ndarray  # (N-1,)
    inside_95: Any  # (M,) which of the stated 95% intervals hold the truth: gaps, then corners' coordinates


def in_frame_of(panels: tuple[PlacedPanel, ...], *, reference: int, reference_x_m: float) -> tuple[PlacedPanel, ...]:
    """Panels in a registration's frame, whose reference panel is at its ideal pose."""
    turn = panels[reference].rotation.T
    middle, shift = panels[reference].centre_m, np.array([reference_x_m, 0.0, 0.0])
    return tuple(PlacedPanel(turn @ p.rotation, turn @ (p.centre_m - middle) + shift) for p in panels)


def errors_of(found: Registration, truth: tuple[PlacedPanel, ...]) -> Errors:
    """Compare with the true panels, in any frame."""
    stack, reference = found.stack, found.bundle.reference
    true = in_frame_of(truth, reference=reference, reference_x_m=stack.x_m[reference])
    matrices, corners = homographies(true, stack, found.eye_m), corner_pixels(stack)
    moving = [index for index in range(stack.count) if index != reference]
    off = np.stack([through(found.homographies[i], corners) - through(matrices[i], corners) for i in moving])
    gap_m = np.diff(found.stack.x_m) - np.diff([panel.axis_x_m for panel in true])
    inside = np.concatenate([
        np.abs(gap_m) <= HALF_WIDTH_95 * found.gap_sigma_m,
        (np.abs(off) <= HALF_WIDTH_95 * found.corner_sigma_px[moving]).ravel(),
    ])  # fmt: skip
    pixels = [error_over_panel_px(found.homographies[i], matrices[i], stack) for i in moving]
    return Errors(np.concatenate(pixels), gap_m, inside)


def error_over_panel_px(found: np.ndarray, truth: np.ndarray, stack: PanelStack) -> np.ndarray:
    """(K,) distance between two homographies at an even grid of a panel's points, pixels."""
    u, v = np.meshgrid(np.linspace(0, stack.width_px, 17), np.linspace(0, stack.height_px, 10))
    points = np.column_stack([u.ravel(), v.ravel()])
    return np.linalg.norm(through(found, points) - through(truth, points), axis=1)


def simulated_photographs(
    stack: PanelStack, truth: tuple[PlacedPanel, ...], *, count: int, random: np.random.Generator
) -> list[np.ndarray]:
    """`count` photographs (h, w) by hand of the boards on a stack."""
    camera, poses = Camera(2800, 2100, 2130.0), by_hand(count, stack, random=random)
    return [photograph(boards(stack), truth, stack, camera, pose, random) for pose in poses]


def photographed(
    stack: PanelStack,
    panels: tuple[PlacedPanel, ...],
    *,
    count: int,
    noise_px: float,
    random: np.random.Generator,
    poses: list[np.ndarray] | None = None,
) -> list[SeenMarks]:
    """Marks as `find_marks` finds them in `count` hand-held photographs by one phone with lens distortion: every saddle
    in the picture, with noise."""
    lens = Camera(4000, 3000, 4000 * random.uniform(0.72, 0.80))
    brown = [random.uniform(-0.06, 0.10), random.uniform(-0.12, 0.05), *random.normal(scale=4e-4, size=2), 0.01]
    found = []
    for number, pose in enumerate(by_hand(count, stack, random=random) if poses is None else poses):
        panel, panel_px, image_px = [], [], []
        for mark in marks(stack):
            points = np.column_stack([mark.saddles_px, np.ones(4)]) @ stack_from_pixels(panels[mark.panel], stack).T
            turn = cv2.Rodrigues(pose[:3, :3])[0]
            seen = cv2.projectPoints(points, turn, pose[:3, 3], lens.matrix, np.array(brown))[0].reshape(-1, 2)
            if (seen > 0).all() and (seen < [lens.width_px, lens.height_px]).all():
                panel += [mark.panel] * 4
                panel_px.append(mark.saddles_px)
                image_px.append(seen + random.normal(size=(4, 2)) * noise_px)
        counts = tuple(panel.count(index) // 4 for index in range(stack.count))
        places_px = np.concatenate(panel_px), np.concatenate(image_px)
        size = lens.width_px, lens.height_px
        found.append(SeenMarks(f"{number + 1}.jpg", *size, np.array(panel), *places_px, counts, fault=""))
    return found
