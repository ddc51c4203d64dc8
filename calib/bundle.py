"""Estimate every panel's pose by bundle adjustment, together with one camera's lens and poses.

The panels' known pixel pitch sets the scale. The reference panel is fixed at its ideal pose and defines the stack's
frame; every other panel has six degrees of freedom. A robust fit (soft L1) identifies outliers, and ordinary least
squares on the other points gives an unbiased covariance. SciPy's `least_squares` gives the same covariance (to 1e-11)
but takes 30 times as long, because it decomposes the entire Jacobian.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from calib.detect_marks import SeenMarks
from calib.placed import PlacedPanel, panel_from_pixels
from runtime.optics.stack import PanelStack
from runtime.records import F64

LENS = 9  # fx fy cx cy k1 k2 p1 p2 k3
POSE = 6  # parameters of a pose: rotation vector, translation
FOCAL_GUESSES = (0.6, 0.8, 1.1, 1.6, 2.4)  # initial focal lengths, relative to the photograph's longer side
ROBUST_PX = 0.3  # scale of the soft L1 norm
OUTLIER_SIGMAS = 4.0  # distance, in standard deviations, beyond which a point is an outlier
MIN_SIGMA_PX = 0.01  # minimum noise assumed for the points, so that exact data have no outliers
NO_FIT_PX = 5.0  # median distance beyond which the photographs cannot be of the configured stack
MAX_STEPS, MAX_DAMPING = 60, 1e8
# Prior standard deviations that suit any camera: square pixels, a centred lens and a few percent of distortion. A dozen
# photographs far outweigh the priors.
SQUARE_SIGMA, CENTRE_SIGMA, DISTORTION_SIGMAS = 0.003, 0.03, (0.3, 0.5, 0.005, 0.005, 0.5)


class Undetermined(ValueError):
    """Raised when the photographs do not determine the panels' poses. The message gives the reason."""


@dataclass(frozen=True, slots=True)
class Bundle:
    """A bundle adjustment's result: the panels' poses and their covariance, and the camera's positions."""

    panels: tuple[PlacedPanel, ...]  # rear to front; the reference panel's pose is ideal
    reference: int  # index of the reference panel
    places_m: F64  # (P, 3) camera positions, frame `stack`
    covariance: F64  # (6(N-1), 6(N-1)): rotation about the centre (rad) and shift (m) of each non-reference panel
    sigma_px: float  # standard deviation, per coordinate, of the saddle points in a photograph
    used: NDArray[np.bool_]  # (K,) True for points that are not outliers
    photograph: Any  # (K,) index of the photograph that shows each point

    def sigma_of(self, derived: Any) -> F64:
        """First-order standard deviation of an array that `derived` computes from a sequence of panels."""
        columns = []
        for number, step in enumerate(np.sqrt(np.diag(self.covariance)) * 0.1):
            up, down = (np.asarray(derived(self._stepped(number, signed))) for signed in (step, -step))
            columns.append((up - down) / (2 * step))
        slope = np.stack(columns, axis=-1)
        return np.asarray(np.sqrt(np.einsum("...i,ij,...j->...", slope, self.covariance, slope)), dtype=np.float64)

    def _stepped(self, number: int, step: float) -> tuple[PlacedPanel, ...]:
        """Return the panels after changing parameter `number` by `step`, numbered as in `covariance`."""
        panels, change = list(self.panels), np.zeros(POSE)
        moving = [index for index in range(len(panels)) if index != self.reference][number // POSE]
        change[number % POSE] = step
        turn = Rotation.from_rotvec(change[:3]).as_matrix()
        panels[moving] = PlacedPanel(turn @ panels[moving].rotation, panels[moving].centre_m + change[3:])
        return tuple(panels)


@dataclass(frozen=True, slots=True)
class _State:
    """Current estimate of the lens, the panels' poses and the camera's poses."""

    lens: F64  # (9,) fx, fy, cx, cy, k1, k2, p1, p2, k3 as in OpenCV
    turns: F64  # (N, 3, 3) the panels' rotations, stack_from_panel
    middles_m: F64  # (N, 3) the panels' centres, frame `stack`
    poses: F64  # (P, 4, 4) camera_from_stack for each photograph

    @property
    def camera(self) -> F64:
        """The camera's 3x3 intrinsic matrix."""
        fx, fy, cx, cy = self.lens[:4]
        return np.array([[fx, 0.0, cx], [0.0, fy, cy], [0.0, 0.0, 1.0]])


class _Problem:
    """Least-squares problem: the detected points, their residuals and the derivatives. A step is a vector of changes:
    first to the lens, then to the poses of all panels except the reference, and last to the camera's poses.
    """

    def __init__(self, seen: Sequence[SeenMarks], stack: PanelStack, *, reference: int) -> None:
        self.stack, self.reference, self.photographs = stack, reference, len(seen)
        self.moving = [index for index in range(stack.count) if index != reference]
        points = np.concatenate([s.panel_px for s in seen])
        self.image_px = np.concatenate([s.image_px for s in seen])
        self.panel = np.concatenate([s.panel for s in seen])
        self.photograph = np.repeat(np.arange(len(seen)), [len(s.panel) for s in seen])
        self.local_m = np.column_stack([points, np.ones(len(points))]) @ panel_from_pixels(stack).T
        self.poses_from = LENS + POSE * len(self.moving)
        self.size = self.poses_from + POSE * len(seen)
        self.long_side = max(seen[0].width_px, seen[0].height_px)
        self.middle = np.array([seen[0].width_px - 1, seen[0].height_px - 1]) / 2
        sigmas = [SQUARE_SIGMA * self.long_side, *[CENTRE_SIGMA * self.long_side] * 2, *DISTORTION_SIGMAS]
        self.prior_scale = 1 / np.array(sigmas)

    def stack_m(self, state: _State) -> F64:
        """Return the saddle points' positions in the `stack` frame, as a (K, 3) array."""
        turned = np.einsum("kij,kj->ki", state.turns[self.panel], self.local_m)
        return np.asarray(turned + state.middles_m[self.panel])

    def camera_m(self, state: _State) -> F64:
        """Return the saddle points' positions, each in its photograph's camera frame, as a (K, 3) array."""
        poses = state.poses[self.photograph]
        return np.asarray(np.einsum("kij,kj->ki", poses[:, :3, :3], self.stack_m(state)) + poses[:, :3, 3])

    def residual_px(self, state: _State) -> F64:
        """Return the projected positions minus the detected positions, in pixels, as a (K, 2) array."""
        seen = cv2.projectPoints(self.camera_m(state), np.zeros(3), np.zeros(3), state.camera, state.lens[4:])[0]
        return np.asarray(seen.reshape(-1, 2) - self.image_px, dtype=np.float64)

    def residuals(self, state: _State) -> F64:
        """Return a vector (2K + priors,) of `residual_px` and the lens's deviations, in prior sigmas."""
        lens = state.lens
        prior = np.concatenate([[lens[0] - lens[1]], lens[2:4] - self.middle, lens[4:]]) * self.prior_scale
        return np.concatenate([self.residual_px(state).ravel(), prior])

    def slopes(self, state: _State) -> F64:
        """Return the Jacobian of `residuals` with respect to a step, shape (2K + priors, unknowns)."""
        count = len(self.local_m)
        slopes = cv2.projectPoints(self.camera_m(state), np.zeros(3), np.zeros(3), state.camera, state.lens[4:])[1]
        by_point = slopes[:, 3:6].reshape(count, 2, 3) @ state.poses[self.photograph, :3, :3]
        arms = (self.stack_m(state) - state.middles_m[self.panel])[:, None]
        by_panel = np.concatenate([np.cross(arms, by_point), by_point], axis=-1)
        matrix = np.zeros((2 * count + len(self.prior_scale), self.size))
        matrix[: 2 * count, :LENS] = slopes[:, 6 : 6 + LENS]
        rows = np.arange(2 * count).reshape(count, 2, 1)
        poses = self.poses_from + POSE * self.photograph[:, None, None] + np.arange(POSE)
        matrix[rows, poses] = slopes[:, :POSE].reshape(count, 2, POSE)
        for number, panel in enumerate(self.moving):
            mine = self.panel == panel
            matrix[rows[mine], LENS + POSE * number + np.arange(POSE)] = by_panel[mine]
        prior = matrix[2 * count :]
        prior[0, 0], prior[0, 1] = 1, -1
        prior[1:, 2:LENS] = np.eye(LENS - 2)
        prior *= self.prior_scale[:, None]
        return matrix

    def moved(self, state: _State, step: F64) -> _State:
        """Apply a step to a state and return the new state."""
        panels, cameras = step[LENS : self.poses_from].reshape(-1, POSE), step[self.poses_from :].reshape(-1, POSE)
        turns, middles_m = state.turns.copy(), state.middles_m.copy()
        turns[self.moving] = Rotation.from_rotvec(panels[:, :3]).as_matrix() @ turns[self.moving]
        middles_m[self.moving] += panels[:, 3:]
        change = np.tile(np.eye(4), (len(cameras), 1, 1))
        change[:, :3, :3], change[:, :3, 3] = Rotation.from_rotvec(cameras[:, :3]).as_matrix(), cameras[:, 3:]
        return _State(state.lens + step[:LENS], turns, middles_m, change @ state.poses)

    def start(self, *, reverse: bool = False) -> _State:
        """Return ideal panels, maybe in reverse order, and the best of several focal lengths with its poses."""
        count, origin_m = self.stack.count, self.stack.x_m[self.reference]
        middles_m = np.zeros((count, 3))
        middles_m[:, 0] = origin_m + (np.array(self.stack.x_m) - origin_m) * (-1 if reverse else 1)
        states = []
        for guess in FOCAL_GUESSES:
            focal_px = guess * self.long_side
            lens = np.array([focal_px, focal_px, *self.middle, 0.0, 0.0, 0.0, 0.0, 0.0])
            poses = np.tile(np.eye(4), (self.photographs, 1, 1))
            state = _State(lens, np.tile(np.eye(3), (count, 1, 1)), middles_m, poses)
            points = self.stack_m(state)
            for number, pose in enumerate(poses):
                mine = self.photograph == number
                _, turn, shift = cv2.solvePnP(
                    points[mine], self.image_px[mine], state.camera, np.zeros(5), flags=cv2.SOLVEPNP_SQPNP
                )
                pose[:3, :3], pose[:3, 3] = cv2.Rodrigues(turn)[0], shift.ravel()
            states.append(state)
        return min(states, key=lambda state: float(np.median(np.abs(self.residual_px(state)))))


def _solved(problem: _Problem, state: _State, used: NDArray[np.bool_], *, robust: bool) -> _State:
    """Minimise the residuals of the points in the mask `used` (K,) with the Levenberg-Marquardt method. `robust`
    minimises the soft L1 norm, by iterative reweighting, rather than the sum of squares.
    """
    kept = np.concatenate([np.repeat(used, 2), np.ones(len(problem.prior_scale), bool)])

    def cost_of(residuals: F64) -> float:
        if robust:
            return float((2 * ROBUST_PX**2 * (np.sqrt(1 + (residuals / ROBUST_PX) ** 2) - 1)).sum())
        return float((residuals**2).sum())

    residuals = problem.residuals(state)[kept]
    cost, damping = cost_of(residuals), 1e-4
    for _ in range(MAX_STEPS):
        weights = (1 + (residuals / ROBUST_PX) ** 2) ** -0.5 if robust else np.ones(len(residuals))
        slopes = problem.slopes(state)[kept]
        normal, gradient = slopes.T @ (slopes * weights[:, None]), slopes.T @ (residuals * weights)
        before = cost
        while damping < MAX_DAMPING:
            step = np.linalg.solve(normal + damping * np.diag(np.diag(normal)), -gradient)
            trial = problem.moved(state, step)
            residuals = problem.residuals(trial)[kept]
            if cost_of(residuals) <= cost:
                state, cost, damping = trial, cost_of(residuals), damping / 10
                break
            damping *= 10
        if before - cost <= (1e-5 if robust else 1e-10) * before:
            break
    return state


def _refuse_reverse(problem: _Problem, state: _State) -> None:
    """Raise Undetermined if the order of the panels is the reverse of the configured order. This is so if the
    configured order fits only with a camera behind the stack (which would see a stack mirrored front to rear), or if it
    does not fit but the reverse order does.
    """
    depth_m = problem.camera_m(state)[:, 2]
    behind = any(np.median(depth_m[problem.photograph == number]) <= 0 for number in range(problem.photographs))
    if not behind and _median_px(problem, state) > NO_FIT_PX:
        everything = np.ones(len(problem.image_px), bool)
        other = _solved(problem, problem.start(reverse=True), everything, robust=True)
        behind = _median_px(problem, other) < NO_FIT_PX
    if behind:
        raise Undetermined("the panels are in reverse order; panel 0 must be the rear panel")


def _median_px(problem: _Problem, state: _State) -> float:
    """Return the median distance between the projected and detected points, in pixels."""
    return float(np.median(np.linalg.norm(problem.residual_px(state), axis=1)))


def adjust(seen: Sequence[SeenMarks], stack: PanelStack, *, reference: int) -> Bundle:
    """Estimate every panel's pose from one camera's photographs of the boards, starting from the
    configured geometry. `reference` is the panel that defines frame `stack`. Raises Undetermined if the panels are in
    reverse order, or the photographs are too few or too similar.
    """
    problem = _Problem(seen, stack, reference=reference)
    used = np.ones(len(problem.image_px), bool)
    state = _solved(problem, problem.start(), used, robust=True)
    _refuse_reverse(problem, state)
    for _ in range(6):
        distance = np.linalg.norm(problem.residual_px(state), axis=1)
        # The median length of a vector with two normal coordinates is 1.1774 times their standard deviation.
        sigma = max(float(np.median(distance[used])) / 1.1774, MIN_SIGMA_PX)
        good = distance < OUTLIER_SIGMAS * sigma
        state = _solved(problem, state, good, robust=False)
        if (good == used).all():
            break
        used = good
    freedom = 2 * int(used.sum()) - problem.size
    if freedom <= 0:
        raise Undetermined(
            f"the photographs contain only {int(used.sum())} consistent points for {problem.size} "
            "unknowns; take more photographs"
        )
    residual = problem.residual_px(state)
    sigma = float(np.sqrt((residual[used] ** 2).sum() / freedom))
    return Bundle(
        panels=tuple(map(PlacedPanel, state.turns, state.middles_m)),
        reference=reference,
        places_m=np.asarray(np.linalg.inv(state.poses)[:, :3, 3], dtype=np.float64),
        covariance=_covariance(problem, state, used, sigma=sigma)[LENS : problem.poses_from, LENS : problem.poses_from],
        sigma_px=sigma,
        used=used,
        photograph=problem.photograph,
    )


def _covariance(problem: _Problem, state: _State, used: NDArray[np.bool_], *, sigma: float) -> F64:
    """Return the covariance of all unknowns, for points with a standard deviation of `sigma` pixels. Raises
    Undetermined if the photographs do not determine all unknowns.
    """
    slopes = problem.slopes(state)
    slopes[: 2 * len(used)] /= sigma
    weighted = slopes[np.concatenate([np.repeat(used, 2), np.ones(len(problem.prior_scale), bool)])]
    lengths = np.linalg.norm(weighted, axis=0)
    values, axes = np.linalg.svd(np.linalg.qr(weighted / lengths, mode="r"))[1:]
    if values[-1] < 1e-9 * values[0]:
        raise Undetermined("the photographs do not determine all unknowns; take photographs from more directions")
    root = (axes.T / values) / lengths[:, None]
    return np.asarray(root @ root.T)
