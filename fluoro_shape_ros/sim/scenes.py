"""Seeded scenes: a pair of images with its views and its true backbone."""

from __future__ import annotations

import dataclasses
import itertools
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass
from functools import lru_cache

import cv2
import numpy as np

from ..data import Frame, View
from ..device import REST, Device, Segment
from ..geometry.cameras import project
from . import anatomy as surroundings
from . import carm, gvxr_scene, imaging, placement, shapes, vtk_scene, xray

FRAME_ID = 'isocenter'
LENGTHS = (0.067, 0.188)            # m (Burgner et al. 2011)
RADIUS = 0.0006                     # m
CLUTTER = ('leads', 'wire', 'blades', 'field', 'occluder', 'text')
RENDERERS = ('vtk', 'xray')
DEVICE, BACKGROUND = 0.12, 0.75     # grey levels of protocol P
NOISE_VARIANCE = 0.002              # of protocol P, on [0, 1]
BIPLANE = carm.biplane()
FLUOROSCOPY = imaging.SETTINGS['fluoroscopy']
# (H, W) transmission in a view at an energy in keV
Background = Callable[[np.random.Generator, View, float], np.ndarray]
PROTOCOL_P = carm.biplane(arm=carm.CArm(pixel_size_iso=0.523e-3))


@dataclass(frozen=True)
class Scene:
    """A pair of images and what is true of it."""

    frame: Frame
    truth: np.ndarray           # (N, 3) m, dense, base to tip: the part of the backbone that stands in both fields
    radius: float               # m
    base_position: np.ndarray   # (3,) m, the first true point
    name: str
    seed: int


@dataclass(frozen=True)
class Chain:
    """How a plane of a run takes and shows its images."""

    imaging: imaging.Imaging
    levels: imaging.Levels      # type: ignore[name-defined]    # set once, without the device


@dataclass(frozen=True)
class Run:
    """What stays the same while a device moves: a fluoroscopic run. `scene` renders a moment of it."""

    name: str
    seed: int
    fields: tuple[placement.Field, placement.Field]
    shape: shapes.Spline | shapes.Cannula
    shaft: float                                # m of straight shaft before the shape
    radius: float                               # m
    renderer: str                               # one of RENDERERS
    exposure: xray.Exposure | None = None       # None: protocol P's grey levels, blur and noise
    beams: tuple[np.ndarray, np.ndarray] | None = None     # (H, W) float32 each, transmission without the device;
                                                           # None: open
    text: bool = False                          # burnt in at the border
    device: Device | None = None                # what it is made of; None: a solid rod of `radius`
    chains: tuple[Chain, Chain] | None = None   # how each plane takes and shows its images; None: as `exposure` says

    def backbone(self, t: float = 0.0) -> np.ndarray:
        """(N, 3) the whole device at `t` s of its motion, with what of its shaft lies outside the fields."""
        return placement.with_shaft(shapes.moving(self.shape, t).backbone(), self.shaft)

    def scene(self, t: float = 0.0, index: int = 0, stamp_ns: int = 0) -> Scene:
        """The pair at `t` s of the motion (0: as drawn); `index` picks the noise."""
        return self.scene_of(self.backbone(t), index, stamp_ns)

    def scene_of(self, whole: np.ndarray, index: int = 0, stamp_ns: int = 0) -> Scene:
        """The pair that shows the (N, 3) backbone `whole`."""
        return self._scene(whole, self._frame(whole, index, stamp_ns))

    def scene_averaged(self, whole: np.ndarray, detected: tuple[np.ndarray, np.ndarray]) -> Scene:
        """The pair that shows what was `detected`, and on average over the images before, of the (N, 3) backbone
        `whole`."""
        return self._scene(whole, self.shown(detected))

    def _scene(self, whole: np.ndarray, frame: Frame) -> Scene:
        truth = placement.seen_in_both(whole, self.fields)
        return Scene(frame, truth, self.radius, truth[0], self.name, self.seed)

    def without_device(self, index: int = 0, stamp_ns: int = 0) -> Frame:
        """The pair that is taken before the device comes in: the mask of subtraction angiography."""
        return self._frame(None, index, stamp_ns)

    def detected(self, whole: np.ndarray | None, index: int) -> tuple[np.ndarray, np.ndarray]:
        """(H, W) float32 each: what both planes of a run with `chains` detect, before it is averaged over time and
        shown."""
        rng = np.random.default_rng([self.seed, 1, index])
        return tuple(imaging.detect(self.sharp(whole, i), chain.imaging, chain.levels, rng)
                     for i, chain in enumerate(self.chains))

    def shown(self, detected: tuple[np.ndarray, np.ndarray], stamp_ns: int = 0) -> Frame:
        """The pair that the displays of a run with `chains` make of what was detected."""
        images = [imaging.show(d, chain.imaging, chain.levels) for d, chain in zip(detected, self.chains)]
        return self._framed(tuple(surroundings.burn_in(image) if self.text else image for image in images), stamp_ns)

    def _frame(self, whole: np.ndarray | None, index: int, stamp_ns: int) -> Frame:
        if self.chains is not None:
            return self.shown(self.detected(whole, index), stamp_ns)
        rng = np.random.default_rng([self.seed, 1, index])
        return self._framed(tuple(self._image(whole, i, rng) for i in (0, 1)), stamp_ns)

    def _framed(self, images: tuple[np.ndarray, np.ndarray], stamp_ns: int) -> Frame:
        return Frame(stamp_ns, FRAME_ID, images, tuple(f.view for f in self.fields))

    def sharp(self, whole: np.ndarray | None, i: int, shift_px: tuple[float, float] = (0.0, 0.0)) -> np.ndarray:
        """(H, W) float32: plane `i` before blur and noise, as a share of full scale (P) or of the open beam (X-ray);
        the device's shadow is moved by `shift_px` (u, v)."""
        view = self.fields[i].view
        if any(shift_px):
            # moves the principal point
            view = dataclasses.replace(view, P=view.P + np.outer([*shift_px, 0.0], view.P[2]))
        bare = np.ones((view.height, view.width), np.float32)
        if self.chains is not None:
            beam = bare if whole is None else cv2.exp(-self._depth(whole, view, self.chains[i].imaging.energy_kev))
            return beam if self.beams is None else beam * self.beams[i]
        if self.exposure is None:
            return bare * np.float32(BACKGROUND) if whole is None else grey(whole, self.radius, view, self.renderer)
        beam = bare if whole is None else xray.transmission(whole, self.radius, view, self.exposure)
        return beam if self.beams is None else beam * self.beams[i]

    def _depth(self, whole: np.ndarray, view: View, energy_kev: float) -> np.ndarray:
        """(H, W) float32: the device's optical depth, by this run's renderer."""
        return _depth(whole.tobytes(), self.device, view, energy_kev, self.renderer)

    def said(self) -> str:
        """What was drawn for a run with `chains`, in a line."""
        planes = [f'{c.imaging.photons:.0f} photons, {c.imaging.display}, {c.imaging.bits} bit' for c in self.chains]
        return f'radius {1e3 * self.radius:.2f} mm; a: {planes[0]}; b: {planes[1]}'

    def blurred(self, sharp: np.ndarray, i: int) -> np.ndarray:
        """The (H, W) image of plane `i` as `scene` blurs it."""
        if self.chains is not None:
            return imaging.spread(sharp, self.chains[i].imaging)
        return cv2.GaussianBlur(sharp, (5, 5), 0) if self.exposure is None else xray.blurred(sharp, self.exposure)

    def noise_variance(self, blurred: np.ndarray, i: int) -> np.ndarray:
        """(H, W) float32: of the noise that `scene` adds to each pixel of a `blurred` image of plane `i`."""
        if self.chains is not None:
            return blurred * np.float32(self.chains[i].levels.median / self.chains[i].imaging.photons)
        return (np.full_like(blurred, NOISE_VARIANCE) if self.exposure is None
                else blurred / np.float32(self.exposure.photons))

    def _image(self, whole: np.ndarray | None, i: int, rng: np.random.Generator) -> np.ndarray:
        sharp = self.sharp(whole, i)
        if self.exposure is None:
            return vtk_scene.degrade(sharp, rng, NOISE_VARIANCE)
        image = xray.expose(sharp, self.exposure, rng)
        return surroundings.burn_in(image) if self.text else image


def grey(backbone: np.ndarray, radius: float, view: View, renderer: str) -> np.ndarray:
    """(H, W) float32: a device of grey level DEVICE on BACKGROUND, noise-free, by either renderer.

    The X-ray one is as dark where the beam crosses the device's axis, and brighter towards its edges.
    """
    if renderer == 'vtk':
        return vtk_scene.render(backbone, radius, view, DEVICE, BACKGROUND)
    return np.float32(BACKGROUND) * xray.transmission(backbone, radius, view,
                                                      xray.Exposure(contrast=1 - DEVICE / BACKGROUND))


def protocol_p_run(seed: int, renderer: str = 'vtk', *, views=PROTOCOL_P, kind: str = 'spline', lengths=LENGTHS,
                   radius: float = RADIUS, entering: bool = False) -> Run:
    """The simulation of Burgner et al. 2011: a device of grey level DEVICE on BACKGROUND, 5x5 Gaussian blur, white
    noise of variance 0.002.

    There `views` are 1024x1024 px of 0.523 mm and 90 degrees apart. `kind` is spline or cannula, lengths are (shortest,
    longest) in m; `entering` puts the base outside both fields. Raises ValueError for what does not exist or does not
    fit.
    """
    if renderer not in RENDERERS:
        raise ValueError(f'no renderer is called {renderer!r}: there are {", ".join(RENDERERS)}')
    fields = tuple(placement.Field(v) for v in views)
    shape, shaft = placement.place(np.random.default_rng([seed, 0]), fields, kind, lengths, entering)
    return Run(f'p_{renderer}_{kind}', seed, fields, shape, shaft, radius, renderer)


def protocol_p(seed: int, renderer: str = 'vtk', **options) -> Scene:
    """A still scene of `protocol_p_run`, which takes the same options."""
    return protocol_p_run(seed, renderer, **options).scene()


def xray_run(seed: int, *, views=BIPLANE, exposure: xray.Exposure = xray.Exposure(), anatomy: bool = True,
             clutter: tuple[str, ...] = (), kind: str = 'spline', lengths=LENGTHS, radius: float = RADIUS,
             entering: bool = False, hidden_px: float = 0.0,
             device: Device | None = None, chains: tuple[imaging.Imaging, imaging.Imaging] | None = None,
             background: Background | None = None) -> Run:
    """A run that looks like fluoroscopy: a metal device in front of an anatomy-like background and any of CLUTTER.

    With a `device`, an imaging chain a plane, or a `background` of one's own instead of the drawn anatomy, the physics
    are those of imaging.py, by default FLUOROSCOPY, the rod is then one of `radius` and of exposure's contrast, and the
    rest of exposure does not count.

    An occluder hides a part of the device in plane B only; a wire is a second, weaker device. With `hidden_px` a denser
    plate, in a plane that the seed picks, hides so many px of the device, anywhere but near its ends. The other options
    are those of `protocol_p_run`.
    """
    if unknown := set(clutter) - set(CLUTTER):
        raise ValueError(f'no clutter is called {", ".join(sorted(unknown))}: there are {", ".join(CLUTTER)}')
    apertures = [_aperture(np.random.default_rng([seed, 2, i]), view, clutter) for i, view in enumerate(views)]
    fields = tuple(placement.lit_field(v, a) for v, a in zip(views, apertures))
    shape, shaft = placement.place(np.random.default_rng([seed, 0]), fields, kind, lengths, entering)
    points = shape.backbone()
    if device or chains or background:
        chains = chains or (FLUOROSCOPY, FLUOROSCOPY)
        device = device or Device((Segment(REST, radius, exposure.attenuation(radius)),))
    beams = []
    for i, (view, aperture) in enumerate(zip(views, apertures)):
        rng, size = np.random.default_rng([seed, 3, i]), (view.height, view.width)
        beam = np.ones(size, np.float32) if aperture is None else aperture
        if background:
            beam = beam * background(rng, view, chains[i].energy_kev)
        elif anatomy:
            beam = beam * surroundings.anatomy(rng, size)
        if 'leads' in clutter:
            beam = beam * surroundings.leads(rng, size)
        if 'wire' in clutter:
            second = shapes.random_spline(np.random.default_rng([seed, 4]), 0.4, max_curvature=8.0).backbone()
            beam = beam * xray.transmission(second, 0.6 * radius, view, xray.Exposure(contrast=0.6 * exposure.contrast))
        if 'occluder' in clutter and i == 1:
            beam = beam * surroundings.occluder(rng, size, project(view.P, points[len(points) // 2]))
        beams.append(beam)
    if hidden_px:
        rng = np.random.default_rng([seed, 5])
        i = int(rng.integers(2))
        beams[i] = beams[i] * _plate_over(rng, views[i], points, hidden_px)
    run = Run('_'.join(['xray', kind, *clutter]), seed, fields, shape, shaft, radius, 'xray', exposure, tuple(beams),
              'text' in clutter)
    return run if chains is None else with_device(run, device, chains, apertures)


def with_device(run: Run, device: Device, chains: tuple[imaging.Imaging, imaging.Imaging],
                apertures=(None, None)) -> Run:
    """The run with a `device` in place of its rod, each plane taken and shown by its imaging chain; `apertures` as
    imaging.levels wants them."""
    levels = [imaging.levels(run.sharp(None, i), chain, aperture)
              for i, (chain, aperture) in enumerate(zip(chains, apertures))]
    return dataclasses.replace(run, radius=device.radius, exposure=None, device=device,
                               chains=tuple(map(Chain, chains, levels)))


def xray_scene(seed: int, *, pixel_size_iso: float = 0.3e-3, angle: float = np.pi / 2, photons: float = 1500.0,
               contrast: float = 0.25, depth: int = 8, **options) -> Scene:
    """A still scene of `xray_run`: planes `angle` rad apart; `options` are those of `xray_run`."""
    views = carm.biplane(angle_b=(angle, 0.0), arm=carm.CArm(pixel_size_iso=pixel_size_iso))
    return xray_run(seed, views=views, exposure=xray.Exposure(photons=photons, contrast=contrast, depth=depth),
                    **options).scene()


def still(run: Run, count: int | None = None) -> Iterator[Scene]:
    """`count` scenes (None: without end) of a device at rest, each with noise of its own."""
    return (run.scene(index=k) for k in _first(count))


def moving(run: Run, rate: float, count: int | None = None) -> Iterator[Scene]:
    """`count` scenes (None: without end) of a moving device, `rate` a second. Displays that average over time drag a
    ghost behind it."""
    if run.chains is None or not any(chain.imaging.lag for chain in run.chains):
        yield from (run.scene(k / rate, k) for k in _first(count))
        return
    before = None
    for k in _first(count):
        whole = run.backbone(k / rate)
        now = run.detected(whole, k)
        lags = [np.float32(chain.imaging.lag) for chain in run.chains]
        before = now if before is None else tuple(lag * b + (1 - lag) * n for lag, b, n in zip(lags, before, now))
        yield run.scene_averaged(whole, before)


def ping_pong(pairs: Sequence) -> Iterator:
    """The scenes forth and back without end, so that motion never jumps."""
    return itertools.cycle([*pairs, *pairs[-2:0:-1]])


def _first(count: int | None) -> Iterable[int]:
    return itertools.count() if count is None else range(count)


def _aperture(rng: np.random.Generator, view: View, clutter: tuple[str, ...]) -> np.ndarray | None:
    """(H, W) float32: what collimator blades and the intensifier's circle let through; None where there are neither."""
    makers = {'blades': surroundings.blades, 'field': surroundings.intensifier}
    parts = [make(rng, (view.height, view.width)) for name, make in makers.items() if name in clutter]
    return np.prod(parts, axis=0) if parts else None


def _plate_over(rng: np.random.Generator, view: View, points: np.ndarray, hidden_px: float) -> np.ndarray:
    """(H, W) float32: a plate of 0.3 to 2 % transmission across the image of (N, 3) points, so that it hides
    `hidden_px` of it."""
    k = int(len(points) * rng.uniform(0.2, 0.8))
    centre, ahead = project(view.P, points[[k, k + 5]])
    turn = np.arctan2(*(ahead - centre)[::-1])
    return surroundings.plate((view.height, view.width), centre, (hidden_px, rng.uniform(30, 90)), turn,
                              rng.uniform(0.003, 0.02))


@lru_cache(4)
def _depth(whole: bytes, device: Device, view: View, energy_kev: float, renderer: str) -> np.ndarray:
    """(H, W) float32 of `Run._depth`, kept for both planes with and without what stands behind: it takes longest by
    far."""
    depth = (gvxr_scene if renderer == 'gvxr' else xray).optical_depth(np.frombuffer(whole).reshape(-1, 3), device,
                                                                       view, energy_kev)
    depth.flags.writeable = False
    return depth
