"""A volume that VTK draws by ray casting, shown on the display.

It requires `pip install 'phasestack[vtk]'`. Start `phasestack try --scene program` (or `run`), and then
`python examples/volume.py`. With a folder of DICOM slices as its argument, it shows these (`pip install pydicom`).
"""

from __future__ import annotations

import sys
from pathlib import Path

import numpy as np
from vtkmodules.util.numpy_support import numpy_to_vtk
from vtkmodules.vtkCommonDataModel import vtkImageData, vtkPiecewiseFunction
from vtkmodules.vtkInteractionStyle import vtkInteractorStyleTrackballCamera
from vtkmodules.vtkRenderingCore import (
    vtkColorTransferFunction,
    vtkRenderer,
    vtkRenderWindow,
    vtkRenderWindowInteractor,
    vtkVolume,
    vtkVolumeProperty,
)
from vtkmodules.vtkRenderingVolumeOpenGL2 import vtkSmartVolumeMapper

import phasestack


def shells() -> tuple[np.ndarray, tuple[float, float, float]]:
    """Return a volume (z, y, x) of nested shells with a notch, and its spacing in millimetres."""
    z, y, x = np.mgrid[-1:1:64j, -1:1:64j, -1:1:64j]
    radius = np.sqrt(x**2 + y**2 + z**2)
    values = 800 * np.exp(-(((radius - 0.8) / 0.06) ** 2)) + 1600 * np.exp(-(((radius - 0.35) / 0.12) ** 2))
    values[(x > 0) & (y < 0) & (z > 0)] = 0
    return values.astype(np.float32), (3.0, 3.0, 3.0)


def slices(folder: Path) -> tuple[np.ndarray, tuple[float, float, float]]:
    """Return the volume of a folder of DICOM slices, and its spacing in millimetres."""
    import pydicom

    files = sorted((pydicom.dcmread(path) for path in folder.iterdir()), key=lambda one: one.ImagePositionPatient[2])
    values = np.stack([one.pixel_array * one.RescaleSlope + one.RescaleIntercept for one in files])
    down, across = files[0].PixelSpacing
    apart = abs(files[1].ImagePositionPatient[2] - files[0].ImagePositionPatient[2])
    return values.astype(np.float32), (across, down, apart)


def window_of(values: np.ndarray, spacing: tuple[float, float, float]) -> vtkRenderWindow:
    """Return a window that shows the volume."""
    image = vtkImageData()
    image.SetDimensions(*values.shape[::-1])
    image.SetSpacing(*spacing)
    image.GetPointData().SetScalars(numpy_to_vtk(values.ravel(), deep=True))
    mapper = vtkSmartVolumeMapper()
    mapper.SetInputData(image)
    opacity, colours = vtkPiecewiseFunction(), vtkColorTransferFunction()
    for value, alpha, colour in ((200, 0, (0.5, 0.2, 0.1)), (800, 0.08, (0.9, 0.5, 0.3)), (1600, 0.7, (1, 1, 0.9))):
        opacity.AddPoint(value, alpha)
        colours.AddRGBPoint(value, *colour)
    look = vtkVolumeProperty()
    look.SetScalarOpacity(opacity)
    look.SetColor(colours)
    look.SetInterpolationTypeToLinear()
    look.ShadeOn()
    volume, renderer, window = vtkVolume(), vtkRenderer(), vtkRenderWindow()
    volume.SetMapper(mapper)
    volume.SetProperty(look)
    renderer.AddVolume(volume)
    renderer.SetBackground(0.12, 0.12, 0.12)
    renderer.ResetCamera()
    window.AddRenderer(renderer)
    window.SetSize(960, 540)
    return window


def main() -> None:
    window = window_of(*(slices(Path(sys.argv[1])) if len(sys.argv) > 1 else shells()))
    interactor = vtkRenderWindowInteractor()
    interactor.SetInteractorStyle(vtkInteractorStyleTrackballCamera())
    interactor.SetRenderWindow(window)
    phasestack.attach(window)
    window.Render()
    interactor.Initialize()
    interactor.Start()


if __name__ == "__main__":
    main()
