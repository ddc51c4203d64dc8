"""Tests `phasestack.attach` with VTK, against closed-form projections."""

from __future__ import annotations

import runpy
import threading
import time
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

import phasestack
from phasestack.fitting import comfortable_m
from runtime.config import ContentSettings, StackGeometry
from runtime.content import program_server
from runtime.content.registry import open_content
from runtime.errors import ContentFailure
from runtime.optics.views import image_from_stack
from runtime.plan.drawing import raster_views, retina_pictures
from tests.waiting import eventually

vtk = pytest.importorskip("vtkmodules.all")
volume: Any = SimpleNamespace(**runpy.run_path(str(Path(__file__).parents[1] / "examples" / "volume.py")))

STACK = StackGeometry().stack()
SMALL = replace(STACK, width_px=320, height_px=180)
EYES = [(0.6, 0.0, 0.0), (0.6, 0.15, 0.05), (0.5, -0.2, 0.1), (0.9, 0.1, -0.15), (0.7, -0.05, 0.2)]  # midpoints
DISKS = ((-0.11, 0.05, 0.03), (0.1, 0.06, -0.04), (0.0, 0.0, 0.0), (-0.09, -0.06, -0.03), (0.12, -0.05, 0.02))
COLOURS = ((255, 0, 0), (0, 255, 0), (0, 0, 255), (255, 255, 0), (255, 0, 255))
HALF_IPD_M = 0.0315


def opened(stack: Any) -> Any:
    return open_content(ContentSettings(scene="program"), stack, None)


@pytest.fixture(autouse=True)
def _patient(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(program_server, "ANSWERED_S", 60.0)  # a processor draws slowly
    monkeypatch.setattr(program_server, "GIVEN_UP_S", 120.0)


@pytest.fixture
def small() -> Iterator[Any]:
    source = opened(SMALL)
    yield source
    source.close()


def pair(midpoint_m: tuple[float, float, float]) -> np.ndarray:
    return np.add(midpoint_m, [[0, -HALF_IPD_M, 0], [0, HALF_IPD_M, 0]])


def disks(unit: float, radius_m: float = 0.006) -> Any:
    """A window that shows disks parallel to the display. One metre on the display is `unit` in the scene."""
    window, renderer = vtk.vtkRenderWindow(), vtk.vtkRenderer()
    window.SetOffScreenRendering(True)
    window.SetMultiSamples(0)
    window.SetSize(640, 360)
    window.AddRenderer(renderer)
    for at, colour in zip(DISKS, COLOURS):
        disk, mapper, actor = vtk.vtkRegularPolygonSource(), vtk.vtkPolyDataMapper(), vtk.vtkActor()
        disk.SetNumberOfSides(60)
        disk.SetRadius(radius_m * unit)
        disk.SetCenter(*np.array(at) * unit)
        mapper.SetInputConnection(disk.GetOutputPort())
        actor.SetMapper(mapper)
        actor.GetProperty().SetColor(*np.array(colour) / 255)
        actor.GetProperty().LightingOff()
        renderer.AddActor(actor)
    look(renderer, 0.6 * unit)
    renderer.ResetCameraClippingRange()
    window.Render()
    return window


def look(renderer: Any, distance: float) -> None:
    """Points the camera at the middle, so that the display's height fills the view from 60 cm."""
    camera = renderer.GetActiveCamera()
    camera.SetFocalPoint(0, 0, 0)
    camera.SetPosition(0, 0, distance)
    camera.SetViewUp(0, 1, 0)
    camera.SetViewAngle(2 * np.degrees(np.arctan(STACK.height_m / 2 / 0.6)))


def drawn_by(attachment: Any, draw: Any) -> Any:
    """What `draw` returns on another thread, while the application draws on this one."""
    results: list[Any] = []

    def run() -> None:
        end = time.monotonic() + 100
        while not results and time.monotonic() < end:
            try:
                results.append(draw())
            except ContentFailure:
                time.sleep(0.05)

    thread = threading.Thread(target=run, daemon=True)
    thread.start()
    while thread.is_alive():
        attachment.step()
        time.sleep(0.002)
    return results[0]


def centres(picture: np.ndarray) -> np.ndarray:
    """The (disks, 2) centres of the disks in a picture, in pixels."""
    found = []
    for colour in COLOURS:
        rows, columns = np.nonzero((np.abs(picture[..., :3].astype(int) - colour) < 8).all(-1))
        found.append((columns.mean() + 0.5, rows.mean() + 0.5))
    return np.array(found)


def outline_centre(pixels: np.ndarray) -> np.ndarray:
    """The centre of the area within a closed outline (corners, 2)."""
    after = np.roll(pixels, -1, axis=0)
    cross = pixels[:, 0] * after[:, 1] - after[:, 0] * pixels[:, 1]
    return (pixels + after).T @ cross / (3 * cross.sum())


def seen_from(eye_m: np.ndarray, points_m: np.ndarray) -> np.ndarray:
    return phasestack.project(points_m, eye_m=eye_m.tolist(), width_px=1920, height_px=1080, fov_deg=40)


@pytest.mark.slow
@pytest.mark.parametrize("unit", [1.0, 1000.0])
def test_both_eyes_see_each_point_within_a_tenth_of_a_pixel(unit: float) -> None:
    source, window = opened(STACK), disks(unit, radius_m=0.012)
    attachment = phasestack.attach(window, address=source.program["address"])
    turns = np.linspace(0, 2 * np.pi, 60, endpoint=False)
    circle_m = 0.012 * np.column_stack([0 * turns, np.cos(turns), np.sin(turns)])
    for midpoint_m in EYES:
        attachment._size = 1.0  # at the requested size, however long it takes
        eyes_m = pair(midpoint_m)
        pictures = drawn_by(
            attachment, lambda eyes_m=eyes_m: retina_pictures(source, eyes_m, STACK, fov_deg=40, time_ns=0)
        )
        for eye_m, picture in zip(eyes_m, pictures):
            outlines = [seen_from(eye_m, np.add([x, y, z], circle_m)) for y, z, x in DISKS]
            assert np.abs(centres(picture) - [outline_centre(one) for one in outlines]).max() < 0.1
    attachment.close()
    source.close()


def nearness_in(views: list[Any], source: Any, attachment: Any) -> list[np.ndarray]:
    def draw() -> list[np.ndarray]:
        source.expect(views, time_ns=0)
        both = [(source.render(view, time_ns=0), source.nearness(view, every=1, first=(0, 0))) for view in views]
        return [nearness for _, nearness in both]

    return drawn_by(attachment, draw)


def test_depth_is_told_for_each_picture(small: Any) -> None:
    attachment = phasestack.attach(disks(50.0, radius_m=0.02), address=small.program["address"])
    attachment._size = 1.0
    views = raster_views(pair(EYES[1]), SMALL.panel(1))
    for view, nearness in zip(views, nearness_in(views, small, attachment)):
        for side, up, out in DISKS:
            at = view.pixels_from_stack @ [out, side, up, 1.0]
            column, row = (at[:2] / at[2]).astype(int)
            assert nearness[row, column] == pytest.approx(1 / at[2], rel=1e-3)
        assert nearness[0, 0] == 0
    attachment.close()


@pytest.mark.parametrize("unit", [1e-3, 1e3])
@pytest.mark.parametrize("comfort_deg", [0.5, 1.0])
def test_a_scene_of_any_size_stays_within_the_comfort_budget(small: Any, unit: float, comfort_deg: float) -> None:
    window = disks(unit, radius_m=0.01)
    renderer = window.GetRenderers().GetFirstRenderer()
    for actor in list(renderer.GetActors()):
        actor.SetPosition(0, 0, 15 * actor.GetCenter()[2])  # ten times as deep as the display is high
    attachment = phasestack.attach(window, address=small.program["address"], comfort_deg=comfort_deg)
    attachment._size = 1.0
    views = raster_views(pair(EYES[0]), SMALL.panel(1))
    nearness = np.concatenate([one[one > 0] for one in nearness_in(views, small, attachment)])
    angles_deg = np.degrees(2 * HALF_IPD_M * (nearness - 1 / 0.6))
    assert np.abs(angles_deg).max() <= comfort_deg + 0.01
    assert np.abs(angles_deg).max() > 0.9 * comfort_deg  # and uses it
    attachment.close()


def test_comfort_is_an_angle_between_the_lines_of_sight() -> None:
    front_m, rear_m = comfortable_m(pair((0.6, 0.0, 0.0)), 1.0)
    for distance_m in (0.6 - front_m, 0.6 + rear_m):
        angle = 2 * (np.arctan(HALF_IPD_M / distance_m) - np.arctan(HALF_IPD_M / 0.6))
        assert abs(np.degrees(angle)) == pytest.approx(1.0, rel=0.02)


def test_the_application_keeps_its_camera_its_size_and_its_picture(small: Any) -> None:
    window = disks(1.0)
    camera = window.GetRenderers().GetFirstRenderer().GetActiveCamera()
    before = shot(window)
    attachment = phasestack.attach(window, address=small.program["address"])
    drawn_by(attachment, lambda: retina_pictures(small, pair(EYES[1]), SMALL, fov_deg=40, time_ns=0))
    assert window.GetRenderers().GetFirstRenderer().GetActiveCamera() is camera
    assert tuple(window.GetSize()) == (640, 360) and attachment.frames >= 1
    assert (shot(window) == before).all()
    attachment.close()


def shot(window: Any) -> np.ndarray:
    from vtkmodules.util.numpy_support import vtk_to_numpy

    window.Render()
    pixels = vtk.vtkUnsignedCharArray()
    window.GetRGBACharPixelData(0, 0, 639, 359, 0, pixels)
    return vtk_to_numpy(pixels).copy()


def test_what_the_camera_orbits_follows(small: Any) -> None:
    window = disks(1.0, radius_m=0.02)
    attachment = phasestack.attach(window, address=small.program["address"])
    draw = lambda: retina_pictures(small, pair(EYES[0]), SMALL, fov_deg=40, time_ns=0)[0]  # noqa: E731
    first = centres(drawn_by(attachment, draw))
    window.GetRenderers().GetFirstRenderer().GetActiveCamera().Roll(180)
    turned = centres(drawn_by(attachment, draw))
    middle = [160, 90]
    np.testing.assert_allclose(turned[2], first[2], atol=0.6)
    assert (np.sign(turned[[0, 1, 3, 4]] - middle) == -np.sign(first[[0, 1, 3, 4]] - middle)).all()
    attachment.close()


@pytest.mark.parametrize("mapper", ["vtkFixedPointVolumeRayCastMapper", "vtkSmartVolumeMapper"])
def test_a_volume_is_where_its_points_are(small: Any, mapper: str) -> None:
    x, y, z = np.meshgrid(*[np.linspace(-0.05, 0.05, 41)] * 3, indexing="ij")
    at = np.array([0.02, -0.015, 0.03])  # in the scene: to the right, up, to the viewer
    values = 255 * np.exp(-((x - at[0]) ** 2 + (y - at[1]) ** 2 + (z - at[2]) ** 2) / 0.006**2)
    window = volume.window_of(values.transpose(2, 1, 0).astype(np.float32), (0.0025, 0.0025, 0.0025))
    window.SetOffScreenRendering(True)
    renderer = window.GetRenderers().GetFirstRenderer()
    renderer.SetBackground(0, 0, 0)
    (one,) = renderer.GetVolumes()
    one.SetPosition(-0.05, -0.05, -0.05)
    drawer = getattr(vtk, mapper)()
    drawer.SetInputData(one.GetMapper().GetInput())
    drawer.SetSampleDistance(0.001)
    one.SetMapper(drawer)
    seen_as = one.GetProperty()
    seen_as.ShadeOff()
    seen_as.SetScalarOpacityUnitDistance(0.001)
    seen_as.GetScalarOpacity().RemoveAllPoints()
    seen_as.GetScalarOpacity().AddPoint(0, 0)
    seen_as.GetScalarOpacity().AddPoint(255, 0.05)
    seen_as.GetRGBTransferFunction().RemoveAllPoints()
    seen_as.GetRGBTransferFunction().AddRGBPoint(0, 1, 1, 1)
    look(renderer, 0.6)
    attachment = phasestack.attach(window, address=small.program["address"])
    attachment._size = 1.0
    eyes_m = pair((0.6, 0.1, 0.05))
    pictures = drawn_by(attachment, lambda: retina_pictures(small, eyes_m, SMALL, fov_deg=40, time_ns=0))
    for eye_m, picture in zip(eyes_m, pictures):
        light = picture[..., 0].astype(float)
        rows, columns = np.indices(light.shape) + 0.5
        centre = np.array([(columns * light).sum(), (rows * light).sum()]) / light.sum()
        wanted = phasestack.project(at[[2, 0, 1]], eye_m=eye_m.tolist(), width_px=320, height_px=180, fov_deg=40)
        np.testing.assert_allclose(centre, wanted, atol=0.3)
    attachment.close()


def test_it_connects_again_after_the_display_was_restarted() -> None:
    window, source = disks(1.0), opened(SMALL)
    attachment = phasestack.attach(window, address=source.program["address"])
    assert eventually(lambda: attachment.problem == "")
    source.close()
    assert eventually(lambda: attachment.problem != "")
    again = opened(SMALL)  # at the same address
    assert eventually(lambda: attachment.problem == "")
    assert len(drawn_by(attachment, lambda: retina_pictures(again, pair(EYES[0]), SMALL, fov_deg=40, time_ns=0))) == 2
    attachment.close()
    assert eventually(lambda: again.problem == "the program closed the connection")
    again.close()


def test_wrong_arguments_are_named() -> None:
    with pytest.raises(ValueError, match=r"^plotter: must be a pyvista\.Plotter or a vtkRenderWindow"):
        phasestack.attach(3)
    with pytest.raises(ValueError, match=r"^comfort_deg: must be from 0\.05 to 10 degrees"):
        phasestack.attach(vtk.vtkRenderWindow(), comfort_deg=0)


def test_the_image_projection_is_the_one_that_python_promises() -> None:
    matrix = image_from_stack(np.array(EYES[1]), width_px=1920, height_px=1080, fov_deg=40)
    seen = matrix @ [0.02, 0.05, -0.03, 1.0]
    np.testing.assert_allclose(seen[:2] / seen[2], seen_from(np.array(EYES[1]), np.array([0.02, 0.05, -0.03])))
