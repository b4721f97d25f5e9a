"""Streams of fluoroscopy: a device that advances, withdraws, bends and swings before a patient who breathes, and what
goes wrong meanwhile.

A stream is drawn from a seed: a preset of `devices`, planes, imaging chains, background, motion, and the faults of its
kind, one of KINDS. The background is drawn or projected once and then moved (breathing.py); the device is drawn for
every pair. As in variety.py a stream is drawn anew until its device can be seen in both planes.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from ..data import Frame, View
from ..device import load_device, presets
from . import anatomy, breathing, carm, ct, faults, imaging, motion, placement, xray
from .scenes import Run, Scene, with_device
from .variety import BETWEEN, visible

KINDS = {
    'plain': 'the device moves, the patient breathes, the heart beats',
    'lag': 'and displays average over time: a ghost follows the device',
    'stale_mask': 'and a mask is subtracted that was taken before the patient moved',
    'wire': 'and another wire comes across the device',
    'dark': 'and one plane is dark for 1 s',
    'bolus': 'and contrast medium darkens a part of the field for 2 s',
    'mixed': 'all of this at once',
}
SIZE_PX = 512
PIXELS = 0.25e-3, 0.35e-3           # m a pixel at the isocentre
PRIMARY, SECONDARY = 0.6, 0.3       # rad, of the planes, at most, to either side
RATES = 15.0, 30.0                  # pairs a second
LENGTHS = 0.050, 0.100              # m, of the part that moves, before it is drawn back
SHAPES = 'spline', 'cannula'
ENTERING = 0.7                      # share of the streams whose device comes in through the border
ROUND, COLLIMATED = 0.2, 0.25       # shares whose field is a circle, or between blades
LAG = 0.3, 0.5                      # share of the image before in recursive averaging
MOVED_PX = 2.0, 5.0                 # of the patient since the mask was taken
MASK_AGE_S = 1.0                    # from the mask's last pair to the stream's first
MASK_INDEX = 10**6                  # noise of a mask is no pair's
PATIENTS, DEVICES = 12, 8           # that are drawn: devices before each patient
LOOKED_AT = 0.0, 1 / 3, 2 / 3       # shares of a round of its motion at which a device must be seen


@dataclass(frozen=True)
class Moment:
    """A pair of a stream."""

    scene: Scene
    shown: bool         # whether both images show the device
    whole: np.ndarray   # (N, 3) m, base to tip, with what lies outside the fields


@dataclass(frozen=True, eq=False)
class Stream:
    """What stays the same, and how the rest moves. `pairs` draws it."""

    kind: str           # one of KINDS
    device: str         # preset
    rate: float         # pairs a second
    run: Run            # device, fields, imaging chains
    motion: motion.Motion
    backgrounds: tuple[breathing.Breathing, breathing.Breathing]        # while the stream is taken ...
    before: tuple[breathing.Breathing, breathing.Breathing] | None      # ... and while its mask was;
                                                                        # None: there is none
    apertures: tuple[np.ndarray | None, np.ndarray | None]  # (H, W) float32, what blades and intensifier let through
    wire: faults.Wire | None = None
    bolus: faults.Bolus | None = None
    dark: faults.Dark | None = None

    def backbone(self, t: float) -> np.ndarray:
        """(N, 3) m, base to tip: the whole device at `t` s, with what of its shaft lies outside the fields."""
        return placement.with_shaft(self.motion.backbone(t), self.run.shaft)

    def pairs(self, count: int) -> Iterator[Moment]:
        """The first `count` pairs."""
        averaged: list[np.ndarray | None] = [None, None]
        for k in range(count):
            whole, dark = self.backbone(k / self.rate), [self._dark(i, k / self.rate) for i in (0, 1)]
            detected = self._lit(k / self.rate).detected(whole, k)
            averaged = [None if off else d if last is None
                        else np.float32(chain.imaging.lag) * last + np.float32(1 - chain.imaging.lag) * d
                        # it begins anew once there are X-rays again
                        for d, last, off, chain in zip(detected, averaged, dark, self.run.chains)]
            shown = self.run.shown(tuple(np.zeros_like(d) if a is None else a for d, a in zip(detected, averaged)),
                                   round(k / self.rate * 1e9))
            truth = placement.seen_in_both(whole, self.run.fields)
            yield Moment(Scene(shown, truth, self.run.radius, truth[0], self.kind, self.run.seed), not any(dark), whole)

    def mask(self, count: int) -> list[Frame]:
        """`count` pairs without the device, taken MASK_AGE_S before the stream begins; none where this kind has no
        mask."""
        if self.before is None:
            return []
        times = [-MASK_AGE_S - k / self.rate for k in range(count)]
        return [self.run.shown(self.with_beams([b.at(t) for b in self.before]).detected(None, MASK_INDEX + k))
                for k, t in enumerate(times)]

    def with_beams(self, beams: list[np.ndarray]) -> Run:
        """The run with these (H, W) shares of the beam behind the device, as far as its apertures are open."""
        return dataclasses.replace(self.run, beams=tuple(beam if a is None else beam * a
                                                         for beam, a in zip(beams, self.apertures)))

    def said(self) -> str:
        """What was drawn, in a line."""
        return f'{self.device}, {self.rate:g}/s, {self.run.said()}'

    def _dark(self, plane: int, t: float) -> bool:
        return self.dark is not None and self.dark.plane == plane and self.dark.at(t)

    def _lit(self, t: float) -> Run:
        """The run with what stands in the beams at `t` s."""
        beams = []
        for i, (field, chain, background) in enumerate(zip(self.run.fields, self.run.chains, self.backgrounds)):
            beam = background.at(t)
            if self.wire is not None:
                beam = beam * np.exp(-self.wire.depth(t, field.view, chain.imaging.energy_kev))
            if self.bolus is not None:
                beam = beam * np.exp(np.float32(-self.bolus.share(t)) * self.bolus.depths[i])
            beams.append(beam)
        return self.with_beams(beams)


# ---- drawing


def draw(seed: int, kind: str, volume: ct.Volume | None = None) -> Stream:
    """The first stream of a kind of KINDS that a seed draws whose device can be seen; before a CT, or drawn anatomy.
    Raises ValueError for another kind, and where none turns up."""
    if kind not in KINDS:
        raise ValueError(f'no kind of stream is called {kind!r}: there are {", ".join(KINDS)}')
    for attempt in range(seed * PATIENTS, (seed + 1) * PATIENTS):
        rng = np.random.default_rng([attempt, 21])
        views = _views(rng)
        apertures = _apertures(rng, views)
        patient = breathing.patient(rng, views, volume)
        for _ in range(DEVICES):
            stream = _drawn(rng, attempt, kind, views, apertures, patient)
            if stream is not None:
                return _with_faults(rng, stream)
    raise ValueError(f'no stream of seed {seed} can be seen ({PATIENTS * DEVICES} drawn)')


def _drawn(rng: np.random.Generator, seed: int, kind: str, views: tuple[View, View], apertures,
           patient: breathing.Patient) -> Stream | None:
    """A stream without faults but lag; None where its device does not stay in both fields or can't be seen."""
    device, rate = str(rng.choice(presets())), float(rng.choice(RATES))
    lag = LAG if kind in ('lag', 'mixed') else (0.0, 0.0)
    chains = tuple(dataclasses.replace(imaging.draw(rng), lag=float(rng.uniform(*lag))) for _ in views)
    fields = tuple(placement.lit_field(v, a) for v, a in zip(views, apertures))
    try:
        shape, shaft = placement.place(rng, fields, str(rng.choice(SHAPES)), LENGTHS, bool(rng.random() < ENTERING))
    except ValueError:      # no such shape fits
        return None
    moves, made = motion.draw(rng, shape), load_device(device)
    if not motion.stays_inside(moves, fields):
        return None
    backgrounds = tuple(patient(i, chain.energy_kev) for i, chain in enumerate(chains))
    bare = Run(f'stream_{kind}', seed, fields, shape, shaft, made.radius, 'xray', xray.Exposure())
    stream = Stream(kind, device, rate, bare, moves, backgrounds, None, apertures)
    run = with_device(stream.with_beams([b.at(0.0) for b in backgrounds]), made, chains, apertures)
    if not all(visible(run, True, stream.backbone(t)) for t in LOOKED_AT):
        return None
    return dataclasses.replace(stream, run=run, motion=motion.paced(rng, moves, rate))


def _views(rng: np.random.Generator) -> tuple[View, View]:
    arm = carm.CArm(pixel_size_iso=rng.uniform(*PIXELS), width=SIZE_PX, height=SIZE_PX)
    a, between = rng.uniform(-PRIMARY, PRIMARY), rng.uniform(*BETWEEN) * rng.choice([-1, 1])
    return carm.biplane((a, rng.uniform(-SECONDARY, SECONDARY)), (a + between, rng.uniform(-SECONDARY, SECONDARY)), arm)


def _apertures(rng: np.random.Generator, views: tuple[View, View]) -> tuple[np.ndarray | None, np.ndarray | None]:
    opening = rng.random()
    make = anatomy.intensifier if opening < ROUND else anatomy.blades if opening < ROUND + COLLIMATED else None
    return tuple(make and make(rng, (v.height, v.width)) for v in views)


def _with_faults(rng: np.random.Generator, stream: Stream) -> Stream:
    """The stream with what goes wrong in one of its kind, lag apart."""
    given, every = {}, stream.kind == 'mixed'
    if every or stream.kind == 'stale_mask':
        given |= dict(before=stream.backgrounds, backgrounds=tuple(b.shifted(_moved(rng)) for b in stream.backgrounds))
    if every or stream.kind == 'wire':
        given |= dict(wire=faults.draw_wire(rng, stream.motion))
    if every or stream.kind == 'dark':
        given |= dict(dark=faults.draw_dark(rng))
    if every or stream.kind == 'bolus':
        given |= dict(bolus=faults.draw_bolus(rng, tuple(f.view for f in stream.run.fields)))
    return dataclasses.replace(stream, **given)


def _moved(rng: np.random.Generator) -> tuple[float, float]:
    """(u, v) px that the patient has moved."""
    px, turn = rng.uniform(*MOVED_PX), rng.uniform(0, 2 * np.pi)
    return px * np.cos(turn), px * np.sin(turn)
