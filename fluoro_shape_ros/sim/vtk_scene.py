"""The seed's renderer: a VTK tube seen by a virtual camera, blurred with a 5x5 Gaussian, with white noise (Burgner et
al. 2011, Results).

It shares nothing with `xray` but the View: the tube is a surface here, and a volume there.
"""

from __future__ import annotations

import ctypes
import os
import sys

import cv2
import numpy as np

from ..data import View
from ..device import Device
from ..geometry.cameras import decompose
from ..geometry.curve import arc_length, at_arc_length
from .carm import shadow_box

SIDES = 32          # of the tube: its mean width is 0.3 % below the circle's
SUPERSAMPLING = 4   # VTK's edges are hard: so many samples a pixel and axis make them area fractions ...
# ... taken once for each of these shifts (u, v in samples), so that an edge along an axis is met at 16 places a pixel,
# not at 4
SHIFTS = ((-0.375, 0.125), (-0.125, -0.375), (0.125, 0.375), (0.375, -0.125))

NO_OPENGL = 'the VTK renderer finds no OpenGL: it needs a display, or libEGL with a (software) driver'


class NoOpenGL(OSError):
    """VTK is there, but nothing that it could draw with."""


def render(backbone: np.ndarray, radius: float, view: View, device: float = 0.12,
           background: float = 0.75) -> np.ndarray:
    """(H, W) float32 noise-free grey image in [0, 1] of a tube of `radius` m, as VTK draws it.

    Raises ImportError where VTK is missing and NoOpenGL where it can't draw.
    """
    return background + np.float32(device - background) * coverage(backbone, radius, view)


def degrade(image: np.ndarray, rng: np.random.Generator, variance: float = 0.002) -> np.ndarray:
    """(H, W) uint8: `image` in [0, 1] blurred with a 5x5 Gaussian kernel, plus white noise of `variance`."""
    blurred = cv2.GaussianBlur(image, (5, 5), 0)
    noisy = blurred + np.float32(np.sqrt(variance)) * rng.standard_normal(image.shape, dtype=np.float32)
    return np.rint(np.clip(noisy, 0.0, 1.0) * 255).astype(np.uint8)


def coverage(backbone: np.ndarray, radius: float, view: View) -> np.ndarray:
    """(H, W) float32: the fraction of each pixel that the tube's shadow covers."""
    return _covered([(backbone, radius)], shadow_box(view, backbone, radius), view)


def device_coverage(backbone: np.ndarray, device: Device, view: View) -> np.ndarray:
    """(H, W) float32: the fraction of each pixel that the outline of a device about the (N, 3) backbone, base to tip,
    covers. Errors: `render`."""
    s = arc_length(backbone)
    tubes = []
    for piece in device.pieces(s[-1]):
        start, stop = max(0.0, s[-1] - piece.stop), s[-1] - piece.start
        at = np.concatenate([[start], s[(s > start) & (s < stop)], [stop]])
        tubes.append((at_arc_length(backbone, at), piece.radius))
    return _covered(tubes, shadow_box(view, backbone, device.widest), view)


def _covered(tubes: list[tuple[np.ndarray, float]], box: tuple[np.ndarray, np.ndarray] | None,
             view: View) -> np.ndarray:
    """(H, W) float32: the fraction of each pixel that tubes, (N, 3) points and a radius in m each, cover together; None
    for `box`: none is in sight."""
    image = np.zeros((view.height, view.width), np.float32)
    if box is None:
        return image
    low, high = box
    K, R, t = decompose(view.P)
    crop = np.array([[1.0, 0.0, -low[0]], [0.0, 1.0, -low[1]], [0.0, 0.0, 1.0]]) @ K
    drawn = _draw([(points @ R.T + t, radius) for points, radius in tubes], crop, high - low)
    image[low[1]:high[1], low[0]:high[0]] = cv2.resize(drawn, tuple(int(n) for n in high - low),
                                                       interpolation=cv2.INTER_AREA)
    return image


def _draw(tubes: list[tuple[np.ndarray, float]], K: np.ndarray, size: np.ndarray) -> np.ndarray:
    """(h, w) float32 in [0, 1]: tubes, (N, 3) points of the camera's frame (z along the beam) and a radius each, seen
    with intrinsics K.

    `size` is (w, h) in px of K; the image has SUPERSAMPLING times as many.
    """
    try:
        import vtkmodules.vtkRenderingOpenGL2  # noqa: F401, before anything is made: it brings the classes that draw
        from vtkmodules.util.numpy_support import vtk_to_numpy
        from vtkmodules.vtkCommonCore import vtkUnsignedCharArray
        from vtkmodules.vtkRenderingCore import vtkRenderer
    except ImportError as error:
        raise ImportError(f'the VTK renderer needs vtk, which is not installed here ({error}): pip install '
                          '"fluoro_shape_ros[vtk]"') from error
    renderer = vtkRenderer()
    for points, radius in tubes:
        renderer.AddActor(_tube(points * [1.0, -1.0, -1.0], radius))        # OpenGL: y up, looking along -z
    w, h = (SUPERSAMPLING * int(n) for n in size)
    near = min(points[:, 2].min() - 2 * radius for points, radius in tubes)
    far = max(points[:, 2].max() + 2 * radius for points, radius in tubes)
    window = _offscreen_window()
    window.SetMultiSamples(0)
    window.SetSize(w, h)
    window.AddRenderer(renderer)
    pixels = vtkUnsignedCharArray()
    hits = np.zeros((h, w), np.float32)
    for du, dv in SHIFTS:
        shifted = np.array([[1.0, 0.0, du / SUPERSAMPLING], [0.0, 1.0, dv / SUPERSAMPLING], [0.0, 0.0, 1.0]]) @ K
        _aim(renderer.GetActiveCamera(), _clip_from_camera(shifted, size, near, far))
        window.Render()
        window.GetPixelData(0, 0, w - 1, h - 1, 0, pixels, 0)
        hits += vtk_to_numpy(pixels).reshape(h, w, 3)[::-1, :, 0] > 127      # VTK's first row is the lowest
    window.Finalize()
    return hits / len(SHIFTS)


def _tube(points: np.ndarray, radius: float):
    """A vtkActor: the unlit white tube of `radius` with flat ends about (N, 3) points."""
    from vtkmodules.util.numpy_support import numpy_to_vtk
    from vtkmodules.vtkCommonCore import vtkPoints
    from vtkmodules.vtkFiltersCore import vtkTubeFilter
    from vtkmodules.vtkFiltersSources import vtkLineSource
    from vtkmodules.vtkRenderingCore import vtkActor, vtkPolyDataMapper
    corners = vtkPoints()
    corners.SetData(numpy_to_vtk(np.ascontiguousarray(points), deep=True))
    line = vtkLineSource()
    line.SetOutputPointsPrecision(1)        # double
    line.SetPoints(corners)
    tube = vtkTubeFilter()
    tube.SetInputConnection(line.GetOutputPort())
    tube.SetRadius(radius)
    tube.SetNumberOfSides(SIDES)
    tube.SetCapping(True)
    tube.SetOutputPointsPrecision(1)
    mapper = vtkPolyDataMapper()
    mapper.SetInputConnection(tube.GetOutputPort())
    actor = vtkActor()
    actor.SetMapper(mapper)
    actor.GetProperty().SetLighting(False)
    actor.GetProperty().SetColor(1.0, 1.0, 1.0)
    return actor


def _clip_from_camera(K: np.ndarray, size: np.ndarray, near: float, far: float) -> np.ndarray:
    """(4, 4) OpenGL projection: camera frame (y up, looking along -z) to clip coordinates.

    Pixel centres lie at integers, so the image reaches from -0.5 to size - 0.5 and the edges go to -1 and +1.
    """
    w, h = size
    ndc_from_px = np.array([[2 / w, 0.0, 1 / w - 1], [0.0, -2 / h, 1 - 1 / h], [0.0, 0.0, 1.0]])
    clip = np.zeros((4, 4))
    clip[[0, 1, 3], :3] = ndc_from_px @ K
    clip[2, 2], clip[2, 3] = (far + near) / (far - near), -2 * far * near / (far - near)
    return clip * [1.0, -1.0, -1.0, 1.0]


def _aim(camera, clip: np.ndarray) -> None:
    """Stand a vtkCamera at the X-ray source, with the (4, 4) projection `clip`."""
    from vtkmodules.vtkCommonMath import vtkMatrix4x4
    matrix = vtkMatrix4x4()
    matrix.DeepCopy(clip.ravel().tolist())
    camera.SetPosition(0.0, 0.0, 0.0)
    camera.SetFocalPoint(0.0, 0.0, -1.0)
    camera.SetViewUp(0.0, 1.0, 0.0)
    camera.SetUseExplicitProjectionTransformMatrix(True)
    camera.SetExplicitProjectionTransformMatrix(matrix)


def _offscreen_window():
    """A window that needs no display: EGL where there is none. Raises NoOpenGL where OpenGL is missing altogether."""
    from vtkmodules import vtkRenderingOpenGL2
    from vtkmodules.vtkRenderingCore import vtkRenderWindow
    headless = sys.platform.startswith('linux') and not os.environ.get('DISPLAY')
    # VTK crashes instead of saying so
    if headless and not any(map(_loads, ('libEGL.so.1', 'libOSMesa.so.8', 'libOSMesa.so'))):
        raise NoOpenGL(NO_OPENGL)
    # asked for by name, since VTK's own search tries X first and complains aloud
    window = (vtkRenderingOpenGL2.vtkEGLRenderWindow()
              if headless and hasattr(vtkRenderingOpenGL2, 'vtkEGLRenderWindow') else vtkRenderWindow())
    window.SetOffScreenRendering(True)
    if not window.SupportsOpenGL():
        raise NoOpenGL(NO_OPENGL)
    return window


def _loads(library: str) -> bool:
    """Whether the system has a shared library."""
    try:
        ctypes.CDLL(library)
    except OSError:
        return False
    return True
