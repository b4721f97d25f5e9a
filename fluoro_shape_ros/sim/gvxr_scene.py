"""A renderer that is not ours: gVirtualXray (Vidal et al. 2009) draws a device as closed triangle meshes in a block of
water.

It knows a point source, a flat detector, meshes and their attenuation, and takes Beer-Lambert's law along each ray. So
it shares nothing with `xray` but the View and what the device is made of.
"""

from __future__ import annotations

import os
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from functools import lru_cache

import numpy as np

from ..data import View
from ..device import Device, attenuation, water_attenuation
from ..geometry.cameras import decompose
from . import mesh
from .carm import shadow_box

# Points of a pixel at which rays are taken (u, v in px): a Fibonacci lattice, which meets an edge along either axis at
# 13 places
SAMPLES = np.stack([np.arange(13), np.arange(13) * 8 % 13], axis=1) / 13 - 6 / 13
MARGIN = 1e-3           # m of water around the device
MOST_SKEW_PX = 0.01     # that is taken for none
DARKEST = np.finfo(np.float32).tiny

PACKAGES = ('libegl1 libgl1-mesa-dri libgl1 libopengl0 libsm6 libxrender1 libxcb-composite0 libxcb-cursor0 '
            'libxcb-ewmh2 libxcb-icccm4 libxcb-keysyms1 libxcb-res0 libxcb-shape0 libxcb-xinerama0 libxcb-xkb1')

# gVirtualXray has one OpenGL context a process, which belongs to a thread; where VTK draws in that thread too, pictures
# go wrong without a word
_thread = ThreadPoolExecutor(1, 'gvxr')


class NoOpenGL(OSError):
    """gVirtualXray is there, but nothing that it could draw with, or that draws as much as is asked for."""


def optical_depth(backbone: np.ndarray, device: Device, view: View, energy_kev: float,
                  tissue: float | None = None) -> np.ndarray:
    """(H, W) float32: what a device about the (N, 3) backbone, base to tip, adds to the integral of attenuation along
    the X-rays; mean over each pixel.

    `tissue`: m, how thick a block of water it lies in; None: one that just holds it. Values end near 80, where the beam
    does in float32. Raises ImportError where gVirtualXray or a library that it needs is missing, NoOpenGL where it
    can't draw, ValueError where the block doesn't hold the device or reaches the source, and for pixels that are no
    rectangles.
    """
    image = np.zeros((view.height, view.width), np.float32)
    box = shadow_box(view, backbone, device.widest)
    if box is not None:
        _within(image, box)[:] = -np.log(_beams(backbone, device, view, energy_kev, tissue, box)).mean(axis=0)
    return image


def transmission(backbone: np.ndarray, device: Device, view: View, energy_kev: float,
                 tissue: float | None = None) -> np.ndarray:
    """(H, W) float32: the share of the beam behind the block of water that the device lets through; mean over each
    pixel, as a detector takes it.

    At sharp edges that is more than exp(-optical_depth), which is what `xray` makes of a pixel. Arguments and errors:
    `optical_depth`.
    """
    image = np.ones((view.height, view.width), np.float32)
    box = shadow_box(view, backbone, device.widest)
    if box is not None:
        _within(image, box)[:] = _beams(backbone, device, view, energy_kev, tissue, box).mean(axis=0)
    return image


def _within(image: np.ndarray, box: tuple[np.ndarray, np.ndarray]) -> np.ndarray:
    """What of the image lies between two corners (u, v)."""
    low, high = box
    return image[low[1]:high[1], low[0]:high[0]]


def _beams(backbone: np.ndarray, device: Device, view: View, energy_kev: float, tissue: float | None,
           box: tuple[np.ndarray, np.ndarray]) -> np.ndarray:
    """(S, h, w) float32: the share of the beam that the device lets through at each of SAMPLES, in the pixels between
    two corners (u, v)."""
    K, R, t = decompose(view.P)
    skew = K[0, 1] / K[1, 1]
    if abs(skew) * view.height > MOST_SKEW_PX:
        raise ValueError(f'plane {view.name}: gVirtualXray has rectangular pixels only, '
                         f'not such as are skewed by {skew:.2g}')
    water = water_attenuation(energy_kev)
    parts = [(vertices @ R.T + t, triangles, attenuation(material, energy_kev) + water)
             for material, (vertices, triangles) in mesh.device_meshes(backbone, device).items()]
    near, far = _block(np.concatenate([vertices[:, 2] for vertices, _, _ in parts]), tissue, view.name)
    first, last = ((corner - 0.5 - K[:2, 2]) / K.diagonal()[:2] for corner in box)      # x / z and y / z
    reach = 1.1 * far * np.maximum(np.abs(first), np.abs(last))
    block = (*mesh.box(np.append(-reach, near), np.append(reach, far)), water)
    behind = 1.05 * far
    pitch = behind / K.diagonal()[:2]
    detectors = behind * np.append((first + last) / 2, 1.0) + np.pad(SAMPLES * pitch, ((0, 0), (0, 1)))
    beams = _thread.submit(_draw, block, parts, detectors, np.abs(pitch), box[1] - box[0], energy_kev).result()
    return beams[:, :, ::-1] if K[0, 0] < 0 else beams      # a mirrored image


def _block(depths: np.ndarray, tissue: float | None, plane: str) -> tuple[float, float]:
    """Depths (m) between which the block of water lies, about a device whose vertices have (V,) `depths`."""
    near, far = depths.min() - MARGIN, depths.max() + MARGIN
    if tissue is not None:
        if tissue < far - near:
            raise ValueError(f'plane {plane}: {tissue:g} m of tissue do not hold a device that reaches over '
                             f'{far - near:.3g} m along the beam')
        near, far = (near + far - tissue) / 2, (near + far + tissue) / 2
    if near <= 0:
        raise ValueError(f'plane {plane}: the tissue around the device reaches the X-ray source')
    return near, far


def _draw(block: tuple, parts: list[tuple], detectors: np.ndarray, pitch: np.ndarray, size: np.ndarray,
          energy_kev: float) -> np.ndarray:
    """(S, h, w) float32 in (0, 1]: the beam behind block and device over that behind the block alone, with the
    detector's middle at (S, 3) points in m.

    `block` and each of `parts` are vertices in m, triangles and attenuation in 1/m; `size` is (w, h) in px of `pitch`
    (2,) m. All stands in the camera's frame: the source at 0, u along x, v along y, the beam along z.
    """
    gvxr = _gvxr()
    origin = np.concatenate([vertices for vertices, _, _ in parts]).mean(axis=0)    # float32 is finest there

    def mm(points: np.ndarray) -> np.ndarray:
        return 1e3 * (points - origin)

    def add(name: str, vertices: np.ndarray, triangles: np.ndarray, mu: float) -> None:
        gvxr.makeTriangularMesh(name, mm(vertices).astype(np.float32).ravel(),
                                triangles.astype(np.uint32).ravel(), 'mm')
        gvxr.setLinearAttenuationCoefficient(name, float(mu / 100), 'cm-1')

    def picture(detector: np.ndarray) -> np.ndarray:
        gvxr.setDetectorPosition(*mm(detector).tolist(), 'mm')
        return np.array(gvxr.computeXRayImage(), np.float32)[::-1]      # its first row is the lowest

    try:
        gvxr.removePolygonMeshesFromSceneGraph()
        gvxr.setMonoChromatic(float(energy_kev), 'keV', 1)
        gvxr.setSourcePosition(*mm(np.zeros(3)).tolist(), 'mm')
        gvxr.setDetectorPosition(*mm(detectors[0]).tolist(), 'mm')
        gvxr.setDetectorUpVector(0.0, -1.0, 0.0)
        gvxr.setDetectorRightVector(1.0, 0.0, 0.0)
        gvxr.setDetectorNumberOfPixels(*size.tolist())
        gvxr.setDetectorPixelSize(*(1e3 * pitch).tolist(), 'mm')
        add('block', *block)
        # where there are no inner surfaces, what those of the last scene took out of an outer one stays out: alone, the
        # block is an inner one too
        gvxr.addPolygonMeshAsInnerSurface('block')
        alone = picture(detectors.mean(axis=0))
        gvxr.removePolygonMeshesFromXRayRenderer()
        gvxr.addPolygonMeshAsOuterSurface('block')
        for k, part in enumerate(parts):
            add(f'part {k}', *part)
            gvxr.addPolygonMeshAsInnerSurface(f'part {k}')
        return np.stack([np.clip(picture(detector) / alone, DARKEST, 1) for detector in detectors])
    except RuntimeError as error:
        raise NoOpenGL(f'gVirtualXray could not draw {size[0]}x{size[1]} px: {_first_line(error)}') from error


@lru_cache(1)
def _gvxr():
    """The module, with an OpenGL context that is current in this thread."""
    try:
        from gvxrPython3 import gvxr
    except ImportError as error:
        raise ImportError(f'the gVirtualXray renderer can not be loaded here ({error}): pip install '
                          f'"fluoro_shape_ros[gvxr]", and on Debian or Ubuntu apt install {PACKAGES}') from error
    gvxr.useLogFile(os.devnull)
    try:
        with _silent():
            gvxr.createWindow(-1, False, 'EGL')
    except RuntimeError as error:
        raise NoOpenGL('gVirtualXray finds no OpenGL: it needs libEGL with a (software) driver '
                       f'({_first_line(error)})') from error
    gvxr.disableArtefactFiltering()
    gvxr.usePointSource()
    return gvxr


@contextmanager
def _silent() -> Iterator[None]:
    """Nothing reaches stdout and stderr: what EGL tries in vain says so there, past gVirtualXray's own log."""
    kept = [os.dup(fd) for fd in (1, 2)]
    nowhere = os.open(os.devnull, os.O_WRONLY)
    try:
        for fd in (1, 2):
            os.dup2(nowhere, fd)
        yield
    finally:
        for fd, old in zip((1, 2), kept):
            os.dup2(old, fd)
        for fd in (nowhere, *kept):
            os.close(fd)


def _first_line(error: Exception) -> str:
    return str(error).split('\n')[0]
