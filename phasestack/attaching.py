"""Show a VTK or PyVista application in 3D for the viewer's eyes."""

from __future__ import annotations

import time
from typing import Any

import cv2
import numpy as np

from phasestack.drawing import DrawingClient, DrawingRequest, checked_budget
from phasestack.fitting import AppCamera, EyeCamera, eye_camera, stack_from_scene
from runtime.errors import InputError
from runtime.records import F32, U8
from runtime.support.extras import missing_extra

POLL_MS = 10  # how often a request is looked for while the application waits for its user
SLOW_S = 0.12  # smaller pictures are drawn if a frame takes longer than this
FAST_S = 0.03  # larger pictures are drawn again if a frame takes less
SMALLEST = 0.25  # smallest pictures, as a fraction of the requested width and height


def attach(plotter: Any, *, address: str = "", comfort_deg: float = 1.0, name: str = "") -> Attachment:
    """Show the scene of a `pyvista.Plotter`, or a `vtkRenderWindow` with a renderer, on the display.

    The application keeps its window, camera and interaction. The display shows the scene for the viewer's eyes: its
    camera's focal point is at the display's centre, and the window's section fills the display. While the application
    waits for its user (`plotter.show()` or an interactor's `Start`), frames are drawn as they are requested. An
    application without such a loop calls `serve` or `step`. The attachment's `close` ends it.

    Args:
       address: Address of the scene `program`, as shown by `phasestack status`. By default, it is looked for.
       comfort_deg: Largest difference in vergence between the content and the display. A deeper scene is flattened.
       name: The application's name in phasestack's log.

    Raises ValueError, which begins with the argument's name, and MissingPart without the extra `vtk`.
    """
    window = plotter if hasattr(plotter, "GetRenderers") else getattr(plotter, "render_window", None)
    if window is None or not hasattr(window, "GetRenderers"):
        raise ValueError("plotter: must be a pyvista.Plotter or a vtkRenderWindow that is still open")
    try:
        comfort_deg = checked_budget(comfort_deg)
    except InputError as error:
        raise ValueError(f"comfort_deg: {error.problem}") from None
    return Attachment(window, address, comfort_deg, name or type(plotter).__name__)


class Attachment:
    """A VTK window whose scene the display shows."""

    def __init__(self, window: Any, address: str, comfort_deg: float, name: str) -> None:
        try:
            from vtkmodules import vtkCommonCore, vtkRenderingCore
            from vtkmodules.util.numpy_support import vtk_to_numpy
            from vtkmodules.vtkCommonMath import vtkMatrix4x4
        except ImportError as error:
            raise missing_extra(error) or error from None
        self._vtk, self._core, self._matrix = vtkRenderingCore, vtkCommonCore, vtkMatrix4x4
        self._to_numpy: Any = vtk_to_numpy
        self._window, self._comfort_deg = window, comfort_deg
        self._client = DrawingClient(address, name=name)
        self._size = 1.0  # fraction of the requested width and height that is drawn
        self._timer: int | None = None
        self._observers: list[tuple[Any, int]] = []
        self._drawing = False
        self.frames = 0  # number of frames drawn so far
        self._observe(window.GetInteractor())

    @property
    def problem(self) -> str:
        """Reason for a missing picture, in one line; empty if the display asks for pictures."""
        return self._client.problem

    def serve(self, seconds: float) -> None:
        """Draw frames as they are requested, for some time. For applications without an interactor's loop."""
        until_s = time.monotonic() + seconds
        while time.monotonic() < until_s:
            if not self.step():
                time.sleep(POLL_MS / 1e3)

    def step(self) -> bool:
        """Draw the newest requested frame. Returns False if there is none."""
        if self._drawing or self._window.CheckInRenderStatus():
            return False
        request = self._client.newest()
        if request is None:
            return False
        self._drawing = True
        try:
            self._draw(request)
        finally:
            self._drawing = False
        return True

    def close(self) -> None:
        """End the attachment. The application continues."""
        self._client.close()
        for subject, tag in self._observers:
            subject.RemoveObserver(tag)
        self._observers.clear()
        interactor = self._window.GetInteractor()
        if self._timer and interactor is not None:
            interactor.DestroyTimer(self._timer)
        self._timer = None

    def _observe(self, interactor: Any) -> None:
        if interactor is None:
            return
        self._observers += [
            (interactor, interactor.AddObserver("TimerEvent", self._on_timer)),
            (interactor, interactor.AddObserver("ExitEvent", self._on_exit)),
            (interactor, interactor.AddObserver("EnableEvent", self._on_enable)),
        ]
        if interactor.GetInitialized():
            self._on_enable(interactor, "")

    def _on_enable(self, interactor: Any, _: str) -> None:
        if not self._timer:
            self._timer = interactor.CreateRepeatingTimer(POLL_MS) or None

    def _on_timer(self, _: Any, __: str) -> None:
        self.step()

    def _on_exit(self, _: Any, __: str) -> None:
        self.close()

    def _draw(self, request: DrawingRequest) -> None:
        """Draw both eyes' pictures into the window's hidden buffer. What the window shows stays as it is."""
        window, begun_s = self._window, time.monotonic()
        shown = window.GetRenderers().GetFirstRenderer()
        if shown is None:
            return
        camera, size = shown.GetActiveCamera(), tuple(window.GetSize())
        renderers = [one for one in _items(window.GetRenderers()) if one.GetActiveCamera() is camera]
        swaps, hidden, dpi = window.GetSwapBuffers(), not window.GetShowWindow(), window.GetDPI()
        placed = self._placed(shown, request, size)
        drawn_px = [max(1, round(edge * self._size)) for edge in (request.width_px, request.height_px)]
        try:
            window.SetSwapBuffers(False)
            if hidden:
                window.SetSize(*drawn_px)
                window.SetDPI(max(1, round(dpi * drawn_px[1] / size[1])))  # text is as large as in the window
            for eye in request.eyes:
                eye_view = self._camera(eye_camera(eye, placed))
                for renderer in renderers:
                    renderer.SetActiveCamera(eye_view)
                window.Render()
                self._client.answer(request, eye, *self._read(request.width_px, request.height_px))
        finally:
            for renderer in renderers:
                renderer.SetActiveCamera(camera)
            if hidden:
                window.SetSize(*size)
                window.SetDPI(dpi)
            window.SetSwapBuffers(swaps)
        self.frames += 1
        took_s = time.monotonic() - begun_s
        if took_s > SLOW_S:
            self._size = max(SMALLEST, self._size * 0.8)
        elif took_s < FAST_S:
            self._size = min(1.0, self._size * 1.1)

    def _placed(self, renderer: Any, request: DrawingRequest, size: tuple[int, ...]) -> Any:
        camera = renderer.GetActiveCamera()
        position, focus = np.array(camera.GetPosition()), np.array(camera.GetFocalPoint())
        distance = float(np.linalg.norm(position - focus))
        height = 2 * distance * np.tan(np.radians(camera.GetViewAngle()) / 2)
        if camera.GetParallelProjection():
            height = 2 * camera.GetParallelScale()
        app = AppCamera(position, focus, np.array(camera.GetViewUp()), float(height), size[0] / size[1])
        low_high = np.reshape(renderer.ComputeVisiblePropBounds(), (3, 2)).T
        bounds = low_high if (low_high[0] <= low_high[1]).all() else None
        eyes_m = np.array([eye.eye_m for eye in request.eyes])
        return stack_from_scene(app, bounds, eyes_m, request.display_m, self._comfort_deg)

    def _camera(self, eye: EyeCamera) -> Any:
        camera = self._vtk.vtkCamera()
        camera.SetPosition(*eye.position)
        camera.SetFocalPoint(*(eye.position + eye.sight * (eye.near + eye.far) / 2))
        camera.SetViewUp(*eye.up)
        camera.SetClippingRange(eye.near, eye.far)
        matrix = self._matrix()
        matrix.DeepCopy(eye.projection.ravel().tolist())
        camera.SetExplicitProjectionTransformMatrix(matrix)
        camera.SetUseExplicitProjectionTransformMatrix(True)
        return camera

    def _read(self, width_px: int, height_px: int) -> tuple[U8, F32]:
        """Return the pixels and depths drawn last, in the requested size, with the bottom row first."""
        columns, rows = self._window.GetSize()
        box = 0, 0, columns - 1, rows - 1
        colours, depths = self._core.vtkUnsignedCharArray(), self._core.vtkFloatArray()
        self._window.GetRGBACharPixelData(*box, 0, colours)
        self._window.GetZbufferData(*box, depths)
        pixels = self._to_numpy(colours).reshape(rows, columns, 4)
        depth = self._to_numpy(depths).reshape(rows, columns)
        if (columns, rows) != (width_px, height_px):
            pixels = cv2.resize(pixels, (width_px, height_px), interpolation=cv2.INTER_LINEAR)
            depth = cv2.resize(depth, (width_px, height_px), interpolation=cv2.INTER_NEAREST)
        return pixels, depth


def _items(collection: Any) -> list[Any]:
    return [collection.GetItemAsObject(n) for n in range(collection.GetNumberOfItems())]
