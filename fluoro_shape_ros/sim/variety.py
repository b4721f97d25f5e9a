"""Runs from a world as wide as the clinic: device, geometry, anatomy, dose, blur, scatter and display drawn at random,
planes unequal.

What no person could find is not asked for: a run is drawn anew until its device is `visible` in both planes.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from typing import Any

import cv2
import numpy as np
from scipy.spatial import cKDTree

from ..data import View
from ..device import REFERENCE_KEV, REST, Device, Segment, load_device, presets, water_attenuation
from ..geometry.cameras import make_view, pixels_per_metre, project
from ..geometry.curve import arc_length
from . import anatomy as surroundings
from . import carm, ct, imaging, placement
from .scenes import Background, Chain, Run, xray_run

SIZE_PX = 1024
SID, SOD = (1.0, 1.3), (0.62, 0.82)         # m
PIXELS = (0.12e-3, 0.45e-3)                 # m a pixel at the isocentre
BETWEEN = np.deg2rad((60.0, 120.0))         # of the planes
PRIMARY, SECONDARY = np.deg2rad(50.0), np.deg2rad(25.0)     # plane A's angles, at most, to either side
OFF_CENTRE_PX = 25.0                        # of the principal point, at most
RADII = (0.2e-3, 2.0e-3)                    # m
CONTRASTS = (0.06, 0.9)                     # of a rod where the beam crosses its axis, at REFERENCE_KEV
SHAPES = ('spline', 'cannula', 'bent', 'hooked')
LENGTHS = (0.040, 0.188)                    # m, where the field has room ...
SHARE = 0.6                                 # ... for so much of its width at the isocentre
DENSITY = (0.7, 1.5)                        # powers that drawn anatomy is raised to
# of drawn anatomy, and the share that has each
PARTS, PART = (surroundings.tissue, surroundings.spine, surroundings.ribs, surroundings.vessels), 0.75
ENTERING, ROUND, COLLIMATED, LEADS, TEXT = 0.3, 0.2, 0.25, 0.1, 0.2     # shares of the runs
VISIBLE, BEFORE_ANATOMY = 1.0, 2.0          # see `visibility`: the signal to noise that is found at a glance, before
                                            # nothing and before anatomy ...
DARKER = 0.02                               # ... on a display that shows the device so much darker
PIECE = 0.008                               # m
ATTEMPTS = 50

Backgrounds = Callable[[np.random.Generator], Background]       # draws one


def wide_run(seed: int, anatomy: bool = False) -> Run:
    """One solid rod, everything about how it is seen drawn anew; before nothing, or drawn anatomy."""
    return _drawn(seed, 'wide_anatomy' if anatomy else 'wide', _random_rod, _drawn_anatomy if anatomy else None)


def device_run(seed: int, preset: str | None = None) -> Run:
    """A device of the package's presets (None: the seed picks one, in turn) before drawn anatomy."""
    preset = preset or presets()[seed % len(presets())]
    return _drawn(seed, preset, lambda rng: load_device(preset), _drawn_anatomy)


def ct_run(seed: int, volume: ct.Volume, preset: str | None = None) -> Run:
    """A device of the presets (None: the seed picks one, in turn) in a CT volume from anywhere; every second one enters
    through the border."""
    kinds = presets()
    preset = preset or kinds[seed % len(kinds)]
    across = min(n * spacing for n, spacing in zip(volume.hu.shape[1:], volume.spacing_m[1:]))
    coarsest = float(np.clip(across / SIZE_PX, 2 * PIXELS[0], PIXELS[1]))       # the body fills the field
    return _drawn(seed, preset, lambda rng: load_device(preset), lambda rng: in_ct(volume, rng),
                  bool(seed // len(kinds) % 2), coarsest)


def gvxr_run(seed: int) -> Run:
    """A rod or a hollow tube in tissue, drawn by gVirtualXray at 0.2 mm a pixel: contrasts from 10 to 90 %, nothing in
    the way."""
    rng = np.random.default_rng([seed, 9])
    radius, contrast = rng.uniform(0.4e-3, 1.2e-3), rng.uniform(0.1, 0.9)
    lumen = radius * rng.uniform(0.5, 0.8) * (seed % 2)
    device = Device((Segment(REST, radius, -np.log1p(-contrast) / (2 * (radius - lumen)), lumen),))
    between = rng.uniform(*BETWEEN)
    views = carm.biplane(angle_b=(between, 0.0), arm=carm.CArm(pixel_size_iso=0.2e-3))
    fields = tuple(placement.Field(v) for v in views)
    shape, shaft = placement.place(rng, fields, 'spline', (0.05, 0.12), entering=False)
    chain = imaging.Imaging(energy_kev=REFERENCE_KEV, photons=1500.0, blur_px=0.7, noise_px=0.4, scatter=0.1,
                            display=str(rng.choice(imaging.DISPLAYS)), bits=12)
    levels = imaging.levels(np.ones((views[0].height, views[0].width), np.float32), chain)
    return Run(('rod', 'tube')[seed % 2], seed, fields, shape, shaft, radius, 'gvxr', device=device,
               chains=(Chain(chain, levels),) * 2)


def visibility(run: Run, whole: np.ndarray | None = None) -> tuple[float, float]:
    """How well a person can see a run's device where it shows least, in the plane that shows it less: (signal to noise,
    grey levels).

    `whole` is its (N, 3) backbone; None: at the start.

    Both are taken in pieces of PIECE, and are those of the lowest tenth of the pieces: the signal-to-noise ratio that a
    matched filter has for each px of length (Rose 1948 asks for 5 in all: 25 px at 1), and by how much the display
    shows the device darker than what lies behind it, as a share of its full scale.
    """
    whole, found = run.backbone() if whole is None else whole, []
    truth = placement.seen_in_both(whole, run.fields)
    pieces = np.minimum((arc_length(truth) / PIECE).astype(int), max(int(arc_length(truth)[-1] / PIECE) - 1, 0))
    for i, (chain, field) in enumerate(zip(run.chains, run.fields)):
        without, shown_with = (run.sharp(w, i) for w in (None, whole))
        before = run.blurred(without, i)
        change = run.blurred(shown_with, i) - before
        ratio = change**2 / run.noise_variance(before, i)
        if chain.imaging.noise_px > 0.1:   # what correlated noise of this variance has at the low frequencies of a line
            ratio /= 1 + 4 * np.pi * np.float32(chain.imaging.noise_px)**2
        fine = dataclasses.replace(chain.imaging, bits=16)
        shown = [imaging.show(imaging.detect(beam, fine, chain.levels, None), fine, chain.levels) / 65535
                 for beam in (without, shown_with)]
        v, u = np.nonzero(np.abs(change) > 0.01 * np.abs(change).max())
        uv = project(field.view.P, truth)
        piece = pieces[cKDTree(uv).query(np.c_[u, v])[1]]
        signal = np.bincount(piece, ratio[v, u], pieces[-1] + 1)
        length_px = np.bincount(pieces[1:], np.linalg.norm(np.diff(uv, axis=0), axis=1), pieces[-1] + 1)
        darker = np.zeros(pieces[-1] + 1)
        np.maximum.at(darker, piece, (shown[0] - shown[1])[v, u])
        found.append((np.percentile(np.sqrt(signal / np.maximum(length_px, 1.0)), 10), np.percentile(darker, 10)))
    return tuple(float(x) for x in np.min(found, axis=0))


def visible(run: Run, before_anatomy: bool, whole: np.ndarray | None = None) -> bool:
    """Whether a person can see a run's device in both planes, all along `whole`, see `visibility`."""
    signal, darker = visibility(run, whole)
    return signal >= (BEFORE_ANATOMY if before_anatomy else VISIBLE) and darker >= DARKER


def _drawn(seed: int, name: str, make_device: Callable[[np.random.Generator], Device], backgrounds: Backgrounds | None,
           entering: bool | None = None, coarsest: float = PIXELS[1]) -> Run:
    """The first visible run that a seed draws. Raises ValueError where none turns up."""
    for attempt in range(seed * ATTEMPTS, (seed + 1) * ATTEMPTS):
        rng = np.random.default_rng([attempt, 7])
        device, views = make_device(rng), draw_views(rng, coarsest)
        room = SHARE * SIZE_PX / max(pixels_per_metre(v.P, np.zeros((1, 3))) for v in views)
        drawn: dict[str, Any] = dict(views=views, kind=str(rng.choice(SHAPES)),
                                     lengths=(min(LENGTHS[0], 0.6 * room), min(LENGTHS[1], room)), device=device,
                     chains=(imaging.draw(rng), imaging.draw(rng)),
                                     entering=bool(rng.random() < ENTERING) if entering is None else entering,
                     clutter=_clutter(rng, backgrounds is not None), anatomy=False)
        try:
            alone = xray_run(attempt, **drawn)
        except ValueError:      # no such shape fits
            continue
        # most that can't be seen can't be seen before nothing either, which takes less time to find out
        if not visible(alone, backgrounds is not None):
            continue
        run = xray_run(attempt, **drawn, background=backgrounds(rng)) if backgrounds else alone
        if run is alone or visible(run, True):
            return dataclasses.replace(run, name=name)
    raise ValueError(f'no {name} of seed {seed} can be seen ({ATTEMPTS} drawn)')


def _clutter(rng: np.random.Generator, before_anatomy: bool) -> tuple[str, ...]:
    """What stands in the beam of both planes, of CLUTTER; leads and text only before anatomy."""
    opening, others = rng.random(), rng.random(2)
    found = ['field'] if opening < ROUND else ['blades'] if opening < ROUND + COLLIMATED else []
    return (*found, *(name for name, drawn, share in zip(('leads', 'text'), others, (LEADS, TEXT))
                      if before_anatomy and drawn < share))


def draw_views(rng: np.random.Generator, coarsest: float = PIXELS[1]) -> tuple[View, View]:
    """Planes A and B of a biplane system, or of a C-arm that turned: angles, distances and pixels (up to `coarsest` m)
    drawn, each plane with its own principal point."""
    pixel, between = (np.exp(rng.uniform(np.log(PIXELS[0]), np.log(coarsest))),
                      rng.uniform(*BETWEEN) * rng.choice([-1, 1]))
    angles = rng.uniform(-PRIMARY, PRIMARY), rng.uniform(-SECONDARY, SECONDARY)
    views = []
    for plane, primary, secondary in (('a', *angles), ('b', angles[0] + between, rng.uniform(-SECONDARY, SECONDARY))):
        arm = carm.CArm(rng.uniform(*SID), rng.uniform(*SOD), float(pixel * rng.uniform(0.9, 1.1)), SIZE_PX, SIZE_PX)
        view = carm.view(plane, primary, secondary, arm)
        off = np.append(rng.uniform(-OFF_CENTRE_PX, OFF_CENTRE_PX, 2), 0.0)
        views.append(make_view(plane, view.P + np.outer(off, view.P[2]), view.width, view.height))
    return tuple(views)


def _random_rod(rng: np.random.Generator) -> Device:
    """A solid rod of drawn radius and contrast, whose attenuation falls with energy as that of metal."""
    radius, contrast = float(np.exp(rng.uniform(*np.log(RADII)))), rng.uniform(*CONTRASTS)
    return Device((Segment(REST, radius, -np.log1p(-contrast) / (2 * radius)),))


def _drawn_anatomy(rng: np.random.Generator) -> Background:
    """Drawn anatomy of a drawn density, which attenuates as water does."""
    density = rng.uniform(*DENSITY)
    parts = [make for make in PARTS if rng.random() < PART] or [surroundings.tissue]

    def background(rng: np.random.Generator, view: View, energy_kev: float) -> np.ndarray:
        beam = np.prod([make(rng, (view.height, view.width)) for make in parts], axis=0)
        return beam**np.float32(density * water_attenuation(energy_kev) / water_attenuation(REFERENCE_KEV))
    return background


def in_ct(volume: ct.Volume, rng: np.random.Generator) -> Background:
    """A CT volume from a drawn place and attitude."""
    where = ct.draw_placement(rng, volume)
    return lambda _, view, energy_kev: cv2.exp(-ct.optical_depth(ct.path_lengths(volume, view, where), energy_kev))
