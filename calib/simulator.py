"""What a camera sees of a stack whose panels are not where they should be.

Every ray of the camera crosses every panel where that panel truly is; the panels' phases along it add up and
sin² of the sum is what is seen (EyeReal, (7)). The lens distorts (Brown), darkens the corners and is out of focus; the
sensor adds shot and read noise; the picture has a tone curve, eight bits and JPEG's losses.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from scipy.spatial.transform import Rotation

from calib.placed import PlacedPanel, stack_from_pixels
from runtime.optics.malus import intensity_from_phase
from runtime.optics.stack import PanelStack
from runtime.records import F32, F64, U8

APERTURE_PX = 0.5  # of the sensor's pixels, on the panels: standard deviation
BLUR_PX = 0.7  # standard deviation: lens, focus and the sensor's own pixels
ELECTRONS, READ_NOISE = 4000.0, 0.003  # at full scale: shot noise; of full scale
VIGNETTING = 0.3  # loss of light in the corners
GAMMA = 2.2  # of the camera's tone curve
JPEG_QUALITY = 92


@dataclass(frozen=True, slots=True)
class Lens:
    """A camera's picture: size, intrinsics and distortion as OpenCV has them (pixel centres at whole numbers)."""

    width_px: int
    height_px: int
    focal_px: float
    centre_px: tuple[float, float]
    distortion: tuple[float, float, float, float, float]  # k1 k2 p1 p2 k3

    @property
    def matrix(self) -> F64:
        """(3, 3) intrinsic matrix."""
        return np.array(
            [[self.focal_px, 0.0, self.centre_px[0]], [0.0, self.focal_px, self.centre_px[1]], [0.0, 0.0, 1.0]]
        )


@dataclass(frozen=True, slots=True)
class Exposure:
    """How a photograph comes out."""

    gain: float = 0.8  # of full scale, white in the middle of the picture
    dark: float = 0.01  # light through crossed polarizers, of full scale
    samples: int = 1  # by as many, of what a pixel of the sensor sees; 1: one, of softened layers (quick)


@dataclass(frozen=True, slots=True)
class Scene:
    """A stack that hands built, and what each panel shows."""

    stack: PanelStack  # the geometry that is believed
    panels: tuple[PlacedPanel, ...]  # the true one
    layers: U8  # (N, H, W) phases of one channel, 255 is a phase of 1


def phone(*, random: np.random.Generator, size: float = 1.0) -> Lens:
    """A phone's main camera, one of many: 26 to 28 mm equivalent, a few per cent of distortion, 12 megapixels.

    size: so much of their width and height.
    """
    width, height = 4000, 3000
    focal = width * random.uniform(0.72, 0.80)
    u, v = (np.array([width, height]) / 2 + random.normal(size=2) * 0.004 * width + 0.5) * size - 0.5
    k1, k2 = random.uniform(-0.06, 0.10), random.uniform(-0.12, 0.05)
    p1, p2 = random.normal(scale=4e-4, size=2)
    distortion = (k1, k2, float(p1), float(p2), float(random.uniform(-0.02, 0.04)))
    return Lens(round(width * size), round(height * size), focal * size, (float(u), float(v)), distortion)


def camera_from_stack(place_m: F64, *, towards_m: F64, roll_rad: float = 0.0) -> F64:
    """(4, 4) pose of a camera (x right, y down, z away) at a place of `stack` that looks towards a point."""
    away = np.asarray(towards_m, dtype=np.float64) - place_m
    away /= np.linalg.norm(away)
    right = np.cross(away, [0.0, 0.0, 1.0])
    right /= np.linalg.norm(right)
    rotation = np.stack([right, np.cross(away, right), away])
    rotation = Rotation.from_rotvec([0.0, 0.0, roll_rad]).as_matrix() @ rotation
    pose = np.eye(4)
    pose[:3, :3], pose[:3, 3] = rotation, -rotation @ place_m
    return pose


def by_hand(count: int, stack: PanelStack, *, random: np.random.Generator) -> list[F64]:
    """`count` poses (4, 4) of a camera that is held by hand round a display, as `docs/setup.md` asks for.

    In turn from the middle, the left, the right, above and below; some with the camera on its side; so near that the
    panel fills most of the picture.
    """
    width = stack.width_m
    near, far = 0.95 * width, 1.35 * width
    directions = [(0, 0), (-32, 4), (32, 4), (0, 24), (0, -22), (-22, 20), (22, 20), (-22, -18), (22, -18), (-38, 0),
                  (38, 0), (12, -26)]  # fmt: skip
    poses = []
    for number in range(count):
        aside, up = np.array(directions[number % len(directions)]) + random.normal(scale=4.0, size=2)
        aside, up = np.radians(aside), np.radians(up)
        toward = np.array([np.cos(up) * np.cos(aside), np.cos(up) * np.sin(aside), np.sin(up)])
        target = np.array([0.0, *random.normal(scale=0.04 * width, size=2)])
        roll = random.normal(scale=np.radians(4.0)) + (np.pi / 2 if number % 4 == 3 else 0.0)
        poses.append(camera_from_stack(toward * random.uniform(near, far), towards_m=target, roll_rad=roll))
    return poses


def camera_rays(lens: Lens) -> tuple[F32, F32]:
    """(h, w) x/z and y/z of the ray of every picture element, its lens's distortion undone: what `photograph` needs."""
    step = 16  # distortion is smooth: undone on a grid, between it interpolated
    columns, rows = lens.width_px // step + 3, lens.height_px // step + 3
    u, v = np.meshgrid(np.arange(columns) * step - step, np.arange(rows) * step - step)
    points = np.stack([u, v], axis=-1).reshape(-1, 1, 2).astype(np.float64)
    criteria = (cv2.TERM_CRITERIA_COUNT | cv2.TERM_CRITERIA_EPS, 60, 1e-12)
    undone = cv2.undistortPointsIter(
        points, lens.matrix, np.array(lens.distortion), np.eye(3), np.eye(3), criteria
    ).reshape(rows, columns, 2)
    # By matrices of weights: OpenCV's own warps would round the places to a 32nd of a step.
    across, down = _weights(lens.width_px, columns, step), _weights(lens.height_px, rows, step)
    x, y = (down @ np.ascontiguousarray(undone[..., axis].astype(np.float32)) @ across.T for axis in (0, 1))
    return x, y


def _weights(length_px: int, nodes: int, step: int) -> F32:
    """(length, nodes) linear interpolation between nodes at -step, 0, step, ..."""
    place = np.arange(length_px)[:, None] / step + 1
    return np.asarray(np.maximum(0, 1 - np.abs(place - np.arange(nodes))), dtype=np.float32)


def photograph(
    scene: Scene, lens: Lens, pose: F64, exposure: Exposure, *, random: np.random.Generator, rays: tuple[F32, F32]
) -> U8:
    """(h, w) the photograph from a camera at `pose` (4, 4; camera_from_stack). rays: `camera_rays(lens)`."""
    x, y = rays
    layers, count = list(scene.layers), exposure.samples
    if count == 1:  # a sensor's pixel is an area: sampled in its middle alone, edges would be jagged
        layers = [cv2.GaussianBlur(layer, (0, 0), APERTURE_PX) for layer in layers]
    steps = (((np.arange(count) + 0.5) / count - 0.5) / lens.focal_px).astype(np.float32)
    light = np.zeros(x.shape, np.float32)
    for across in steps:
        for down in steps:
            light += _light(scene, layers, pose, exposure, x + across, y + down) / np.float32(count**2)
    light = np.asarray(cv2.GaussianBlur(light, (0, 0), BLUR_PX), np.float32)
    return _developed(light, lens, exposure, random)


def _light(scene: Scene, layers: Sequence[U8], pose: F64, exposure: Exposure, x: F32, y: F32) -> F32:
    """(h, w) light along the rays with x/z and y/z, before the lens softens it."""
    total = np.zeros(x.shape, np.float32)
    kind = cv2.INTER_LINEAR if exposure.samples == 1 else cv2.INTER_NEAREST
    inside = np.ones(x.shape, bool)
    for index in range(len(scene.panels)):
        u, v = crossing(scene, index, pose, x, y)
        total += cv2.remap(layers[index], u - np.float32(0.5), v - np.float32(0.5), kind).astype(np.float32)
        inside &= (u > 0) & (u < scene.stack.width_px) & (v > 0) & (v < scene.stack.height_px)
    light = exposure.dark + intensity_from_phase(total * np.float32(1 / 255))
    return np.asarray(light * inside, dtype=np.float32)


def crossing(scene: Scene, index: int, pose: F64, x: F32, y: F32) -> tuple[F32, F32]:
    """(h, w) true pixels u, v of a panel where a camera's rays cross it; x, y: (h, w) the rays' x/z and y/z.

    pose: (4, 4) camera_from_stack.
    """
    panel = scene.panels[index]
    camera_from_pixels = pose[:3, :3] @ stack_from_pixels(panel, scene.stack) + np.outer(pose[:3, 3], [0, 0, 1])
    h = np.linalg.inv(camera_from_pixels).astype(np.float64)
    h = (h / h[2, 2]).astype(np.float32)
    weight = h[2, 0] * x + h[2, 1] * y + h[2, 2]
    return (h[0, 0] * x + h[0, 1] * y + h[0, 2]) / weight, (h[1, 0] * x + h[1, 1] * y + h[1, 2]) / weight


def _developed(light: F32, lens: Lens, exposure: Exposure, random: np.random.Generator) -> U8:
    u = (np.arange(lens.width_px, dtype=np.float32) - lens.centre_px[0]) / lens.width_px
    v = (np.arange(lens.height_px, dtype=np.float32) - lens.centre_px[1])[:, None] / lens.width_px
    corners = 1 - np.float32(VIGNETTING * 2.56) * (u * u + v * v)
    light = np.asarray(light * (np.float32(exposure.gain) * corners), dtype=np.float32)
    noise = random.standard_normal(light.shape, dtype=np.float32)
    spread = np.sqrt(np.maximum(light, 0) / np.float32(ELECTRONS) + np.float32(READ_NOISE**2))
    light = light + noise * spread.astype(np.float32)
    # The tone curve by table: a power of twelve million numbers takes longer than all else.
    codes = np.rint(255 * np.linspace(0, 1, 4096) ** (1 / GAMMA)).astype(np.uint8)
    picture = codes[(np.clip(light, 0.0, 1.0) * 4095).astype(np.int32)]
    coded = cv2.imencode(".jpg", picture, [cv2.IMWRITE_JPEG_QUALITY, JPEG_QUALITY])[1]
    return np.asarray(cv2.imdecode(coded, cv2.IMREAD_GRAYSCALE))
