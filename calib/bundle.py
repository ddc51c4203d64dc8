"""Bundle adjustment: one camera, its places, and six degrees of freedom of every panel, from saddles in photographs.

The panels' own pixel pitch is the metre. The reference panel defines the stack's frame: it lies at its ideal place,
and all else is relative to it. Robust first (soft L1), then what lies far off is left out and the rest is
fitted by plain least squares, so that the covariance is what it says. Derivatives are exact (OpenCV's projection and
the exponential map), the normal equations small: about a hundred unknowns, thousands of coordinates.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.optimize import least_squares
from scipy.spatial.transform import Rotation

from calib.detect_marks import SeenMarks
from calib.placed import PlacedPanel, panel_from_pixels
from runtime.optics.stack import PanelStack
from runtime.records import F64

LENS = 9  # fx fy cx cy k1 k2 p1 p2 k3
POSE = 6
FOCAL_GUESSES = (0.6, 0.8, 1.1, 1.6, 2.4)  # of the longer side
ROBUST_PX = 0.3  # residuals beyond this count by their size, not their square
OUTLIER_SIGMAS = 4.0
MIN_SIGMA_PX = 0.01
NO_FIT_PX = 5.0  # median distance of points beyond which nothing like the configuration was photographed
# What is known of any camera before its first photograph, standard deviations: square pixels, a lens over the
# sensor's middle, distortion of a few per cent. They decide nothing that twelve photographs tell.
SQUARE_SIGMA, CENTRE_SIGMA, DISTORTION_SIGMAS = 0.003, 0.03, (0.3, 0.5, 0.005, 0.005, 0.5)


class Undetermined(ValueError):
    """The photographs do not determine the panels; the text says why."""


@dataclass(frozen=True, slots=True)
class Bundle:
    """What a fit found."""

    panels: tuple[PlacedPanel, ...]  # rear to front, frame of the reference panel
    reference: int
    lens: F64  # (9,) fx fy cx cy k1 k2 p1 p2 k3, pixels of the photographs
    camera_from_stack: F64  # (P, 4, 4)
    covariance: F64  # (6(N-1), 6(N-1)) rotation vector (rad) and middle (m) of every panel but the reference
    sigma_px: float  # of one coordinate of a saddle in a photograph
    residual_px: F64  # (K, 2)
    used: NDArray[np.bool_]  # (K,) not left out as an outlier
    photograph: Any  # (K,) index
    panel: Any  # (K,) index

    @property
    def places_m(self) -> F64:
        """(P, 3) where the camera stood, frame `stack`."""
        turned = np.swapaxes(self.camera_from_stack[:, :3, :3], 1, 2)
        return np.asarray(-(turned @ self.camera_from_stack[:, :3, 3:])[..., 0], dtype=np.float64)

    def parameters(self) -> F64:
        """(6(N-1),) what `covariance` is of."""
        return np.concatenate([
            np.concatenate([Rotation.from_matrix(p.rotation).as_rotvec(), p.centre_m])
            for index, p in enumerate(self.panels) if index != self.reference
        ])  # fmt: skip

    def placed(self, parameters: F64) -> tuple[PlacedPanel, ...]:
        """The panels for other parameters, as `parameters` orders them."""
        found, rows = list(self.panels), iter(parameters.reshape(-1, POSE))
        for index in range(len(found)):
            if index != self.reference:
                row = next(rows)
                found[index] = PlacedPanel(Rotation.from_rotvec(row[:3]).as_matrix(), row[3:].copy())
        return tuple(found)

    def sigma_of(self, derived: Any) -> F64:
        """(...) standard deviation of a function of the panels that answers an array, to first order."""
        start = self.parameters()
        spread = np.sqrt(np.diag(self.covariance))
        columns = []
        for number, step in enumerate(spread * 0.1):
            offset = np.zeros_like(start)
            offset[number] = step
            up, down = (np.asarray(derived(self.placed(start + s * offset))) for s in (1, -1))
            columns.append((up - down) / (2 * step))
        slope = np.stack(columns, axis=-1)
        return np.asarray(np.sqrt(np.einsum("...i,ij,...j->...", slope, self.covariance, slope)), dtype=np.float64)


class _Problem:
    """The unknowns as one vector: lens, panels but the reference, poses of the camera."""

    def __init__(self, seen: Sequence[SeenMarks], stack: PanelStack, *, reference: int) -> None:
        self.seen, self.stack, self.reference = list(seen), stack, reference
        self.moving = [index for index in range(stack.count) if index != reference]
        points = np.concatenate([s.panel_px for s in self.seen])
        self.image_px = np.concatenate([s.image_px for s in self.seen])
        self.panel = np.concatenate([s.panel for s in self.seen])
        self.photograph = np.repeat(np.arange(len(self.seen)), [len(s.panel) for s in self.seen])
        homogeneous = np.column_stack([points, np.ones(len(points))])
        self.local_m = homogeneous @ panel_from_pixels(stack).T
        self.size = LENS + POSE * (len(self.moving) + len(self.seen))
        self.fixed_m = np.array([stack.x_m[reference], 0.0, 0.0])
        long_side = max(self.seen[0].width_px, self.seen[0].height_px)
        middle = np.array([self.seen[0].width_px - 1, self.seen[0].height_px - 1]) / 2
        self.prior_scale = np.array([
            1 / (SQUARE_SIGMA * long_side), *[1 / (CENTRE_SIGMA * long_side)] * 2, *[1 / s for s in DISTORTION_SIGMAS]
        ])  # fmt: skip
        self.middle = middle

    def panel_part(self, index: int) -> slice:
        start = LENS + POSE * self.moving.index(index)
        return slice(start, start + POSE)

    def pose_part(self, photograph: int) -> slice:
        start = LENS + POSE * (len(self.moving) + photograph)
        return slice(start, start + POSE)

    def stack_m(self, x: F64) -> F64:
        """(K, 3) the saddles in the stack's frame."""
        points = np.empty_like(self.local_m)
        for index in range(self.stack.count):
            chosen = self.panel == index
            if index == self.reference:
                points[chosen] = self.local_m[chosen] + self.fixed_m
            else:
                part = x[self.panel_part(index)]
                points[chosen] = self.local_m[chosen] @ Rotation.from_rotvec(part[:3]).as_matrix().T + part[3:]
        return points

    def _project(self, x: F64, points: F64, photograph: int) -> tuple[F64, F64]:
        pose = x[self.pose_part(photograph)]
        camera = np.array([[x[0], 0.0, x[2]], [0.0, x[1], x[3]], [0.0, 0.0, 1.0]])
        projected, slopes = cv2.projectPoints(points, pose[:3], pose[3:], camera, x[4:9])
        return np.asarray(projected, dtype=np.float64).reshape(-1, 2), np.asarray(slopes, dtype=np.float64)

    def residuals(self, x: F64) -> F64:
        """(2K + priors,) found minus seen, pixels; what is known of any camera in units of its spread."""
        points, found = self.stack_m(x), np.empty_like(self.image_px)
        for number in range(len(self.seen)):
            chosen = self.photograph == number
            found[chosen] = self._project(x, points[chosen], number)[0]
        return np.concatenate([(found - self.image_px).ravel(), self._prior(x)])

    def _prior(self, x: F64) -> F64:
        found: F64 = np.concatenate([[x[0] - x[1]], x[2:4] - self.middle, x[4:9]]) * self.prior_scale
        return found

    def slopes(self, x: F64) -> F64:
        """(2K + priors, unknowns) derivatives of `residuals`."""
        points = self.stack_m(x)
        matrix = np.zeros((2 * len(points) + len(self.prior_scale), self.size))
        for number in range(len(self.seen)):
            index = np.flatnonzero(self.photograph == number)
            rows = (2 * index[:, None] + [0, 1]).ravel()
            _, d = self._project(x, points[index], number)
            matrix[rows, self.pose_part(number)] = d[:, :6]
            matrix[rows, :LENS] = d[:, 6 : 6 + LENS]
            turn = cv2.Rodrigues(x[self.pose_part(number)][:3])[0]
            by_point = (d[:, 3:6] @ turn).reshape(-1, 2, 3)  # a shift of the point is a shift of the camera, turned
            for panel in self.moving:
                mine = self.panel[index] == panel
                if not mine.any():
                    continue
                part = x[self.panel_part(panel)]
                arms = points[index][mine] - part[3:]
                by_turn = by_point[mine] @ (-_cross(arms)) @ _left_jacobian(part[:3])
                place = (2 * index[mine][:, None] + [0, 1]).ravel()
                matrix[place, self.panel_part(panel)] = np.concatenate(
                    [by_turn.reshape(-1, 3), by_point[mine].reshape(-1, 3)], axis=1
                )
        prior = matrix[2 * len(points) :]
        prior[0, 0], prior[0, 1] = 1, -1
        prior[1:, 2:LENS] = np.eye(LENS - 2)
        prior *= self.prior_scale[:, None]
        return matrix

    def start(self, *, reverse: bool = False) -> F64:
        """Ideal panels, the focal length for which they explain the photographs best, and poses for it.

        reverse: panels in the reverse of the configuration's order.
        """
        ideal = np.zeros(self.size)
        for index in self.moving:
            off_m = self.stack.x_m[index] - self.fixed_m[0]
            ideal[self.panel_part(index)] = [0, 0, 0, self.fixed_m[0] + (-off_m if reverse else off_m), 0, 0]
        points = self.stack_m(ideal)
        long_side = max(self.seen[0].width_px, self.seen[0].height_px)
        best, least = ideal, np.inf
        for guess in FOCAL_GUESSES:
            x = ideal.copy()
            x[:4] = guess * long_side, guess * long_side, *self.middle
            camera = np.array([[x[0], 0.0, x[2]], [0.0, x[1], x[3]], [0.0, 0.0, 1.0]])
            for number in range(len(self.seen)):
                chosen = self.photograph == number
                _, turn, shift = cv2.solvePnP(
                    points[chosen], self.image_px[chosen], camera, np.zeros(5), flags=cv2.SOLVEPNP_SQPNP
                )
                x[self.pose_part(number)] = np.concatenate([turn.ravel(), shift.ravel()])
            cost = float(np.median(np.abs(self.residuals(x)[: 2 * len(points)])))
            if cost < least:
                best, least = x, cost
        return best


def _cross(vectors: F64) -> F64:
    """(K, 3, 3) cross-product matrices of (K, 3)."""
    x, y, z = vectors.T
    zero = np.zeros_like(x)
    return np.stack([zero, -z, y, z, zero, -x, -y, x, zero], axis=-1).reshape(-1, 3, 3)


def _left_jacobian(rotation_vector: F64) -> F64:
    """(3, 3) turn of a body for a small change of its rotation vector."""
    angle = float(np.linalg.norm(rotation_vector))
    k = _cross(rotation_vector[None])[0]
    if angle < 1e-6:
        return np.asarray(np.eye(3) + k / 2)
    return np.asarray(np.eye(3) + (1 - np.cos(angle)) / angle**2 * k + (angle - np.sin(angle)) / angle**3 * k @ k)


def _solved(problem: _Problem, x: F64, used: NDArray[np.bool_], *, robust: bool) -> F64:
    weights = np.concatenate([np.repeat(used, 2).astype(np.float64), np.ones(len(problem.prior_scale))])

    def residuals(values: F64) -> F64:
        found: F64 = problem.residuals(values) * weights
        return found

    def slopes(values: F64) -> F64:
        found: F64 = problem.slopes(values) * weights[:, None]
        return found

    fit = least_squares(
        residuals,
        x,
        jac=slopes,
        x_scale="jac",
        loss="soft_l1" if robust else "linear",
        f_scale=ROBUST_PX,
        method="trf",
        tr_solver="exact",  # of a hundred unknowns; the sparse solver (LSMR) took three times as many steps
        max_nfev=60,
        xtol=1e-5 if robust else 1e-9,
        ftol=1e-5 if robust else 1e-10,
        gtol=1e-12,
    )
    return np.asarray(fit.x, dtype=np.float64)


def _refuse_reverse(problem: _Problem, x: F64) -> None:
    """Raises Undetermined where the panels stand in the reverse of the configuration's order.

    A stack that is mirrored front to rear, seen by cameras behind it, has the same pictures: only one is real. Or
    nothing that the configuration allows fits, and the reverse does.
    """
    points = problem.stack_m(x)
    behind = False
    for number in range(len(problem.seen)):
        pose = x[problem.pose_part(number)]
        depth_m = (points[problem.photograph == number] @ cv2.Rodrigues(pose[:3])[0].T + pose[3:])[:, 2]
        behind |= bool(np.median(depth_m) <= 0)
    if not behind and _median_px(problem, x) > NO_FIT_PX:
        everything = np.ones(len(problem.image_px), bool)
        other = _solved(problem, problem.start(reverse=True), everything, robust=True)
        behind = _median_px(problem, other) < NO_FIT_PX
    if behind:
        raise Undetermined("the panels stand in the reverse of the configuration's order: panel 0 is the rear one")


def _median_px(problem: _Problem, x: F64) -> float:
    """Of the distances between points and where they were seen."""
    residual = problem.residuals(x)[: 2 * len(problem.image_px)].reshape(-1, 2)
    return float(np.median(np.linalg.norm(residual, axis=1)))


def adjust(seen: Sequence[SeenMarks], stack: PanelStack, *, reference: int) -> Bundle:
    """Fit all panels to the photographs of one camera (of one size). Raises Undetermined."""
    problem = _Problem(seen, stack, reference=reference)
    count = len(problem.image_px)
    everything = np.ones(count, bool)
    x = _solved(problem, problem.start(), everything, robust=True)
    used = everything
    for _ in range(6):
        distance = np.linalg.norm(problem.residuals(x)[: 2 * count].reshape(-1, 2), axis=1)
        # The median length of a vector of two normal coordinates is 1.1774 of their standard deviation.
        sigma = max(float(np.median(distance[used])) / 1.1774, MIN_SIGMA_PX)
        good = distance < OUTLIER_SIGMAS * sigma
        x = _solved(problem, x, good, robust=False)
        if (good == used).all():
            break
        used = good
    _refuse_reverse(problem, x)
    residual = problem.residuals(x)[: 2 * count].reshape(-1, 2)
    slopes = problem.slopes(x)
    kept = np.concatenate([np.repeat(used, 2), np.ones(len(problem.prior_scale), bool)])
    freedom = 2 * int(used.sum()) - problem.size
    if freedom <= 0:
        raise Undetermined(f"{int(used.sum())} points that agree are too few for {problem.size} unknowns")
    sigma = float(np.sqrt((residual[used] ** 2).sum() / freedom))
    scale = np.ones(len(kept))
    scale[: 2 * count] /= sigma
    weighted = slopes[kept] * scale[kept][:, None]
    lengths = np.linalg.norm(weighted, axis=0)
    values, axes = np.linalg.svd(np.linalg.qr(weighted / lengths, mode="r"))[1:]
    if values[-1] < 1e-9 * values[0]:
        raise Undetermined("the photographs leave something undetermined: take them from more directions")
    root = (axes.T / values) / lengths[:, None]
    moving = np.concatenate([np.arange(problem.size)[problem.panel_part(i)] for i in problem.moving])
    covariance = (root @ root.T)[np.ix_(moving, moving)]
    panels = []
    for index in range(stack.count):
        if index == reference:
            panels.append(PlacedPanel(np.eye(3), problem.fixed_m))
        else:
            part = x[problem.panel_part(index)]
            panels.append(PlacedPanel(Rotation.from_rotvec(part[:3]).as_matrix(), part[3:].copy()))
    poses = np.tile(np.eye(4), (len(problem.seen), 1, 1))
    for number in range(len(problem.seen)):
        part = x[problem.pose_part(number)]
        poses[number, :3, :3], poses[number, :3, 3] = cv2.Rodrigues(part[:3])[0], part[3:]
    return Bundle(
        panels=tuple(panels),
        reference=reference,
        lens=x[:LENS].copy(),
        camera_from_stack=poses,
        covariance=covariance,
        sigma_px=sigma,
        residual_px=residual,
        used=used,
        photograph=problem.photograph,
        panel=problem.panel,
    )
