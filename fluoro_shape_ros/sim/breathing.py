"""A background that breathes and beats: one picture of the anatomy, larger than the field, moved by a smooth field of
displacements.

At t s of a run a pixel x shows the picture's x - d(x, t), where

    d = breath (1 - cos(2 pi t BREATHS + phase)) / 2 w(x) e_v + beat sin(2 pi t BEATS + phase') h(x) e + moved

w rises from QUIET at the head's end of the field to 1 below the diaphragm; h is 1 at the heart and falls off around it;
e is a direction, and `moved` how far the patient has moved on the table. What is `still`, a spine, only moves with the
patient.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from dataclasses import dataclass

import cv2
import numpy as np

from ..data import View
from ..device import REFERENCE_KEV, water_attenuation
from . import anatomy, ct

BREATHS, BEATS = 0.25, 1.2          # Hz
BREATH_PX = 10.0, 15.0              # from breathing out to breathing in, below the diaphragm
BEAT_PX = 1.5, 3.0                  # to either side, at the heart
MARGIN_PX = 32                      # that a picture is larger than the field, on each side
QUIET = 0.3                         # share of a breath at the head's end of the field
DIAPHRAGM = 0.35, 0.8               # where it is, share of the field's height
HEART = 0.22                        # sigma, share of the field's width
DENSITY = 0.7, 1.3                  # powers that drawn anatomy is raised to
DOME = 0.4, 0.9                     # optical depth of what lies below a drawn diaphragm, at REFERENCE_KEV


@dataclass(frozen=True, eq=False)
class Breathing:
    """What a plane sees behind the device."""

    picture: np.ndarray         # (H + 2 MARGIN_PX, W + 2 MARGIN_PX) float32, the share of the beam that passes what
                                # moves
    still: np.ndarray           # the same size, what passes the rest
    breath: np.ndarray          # (H, W) float32, w
    breath_px: float
    breath_phase: float         # rad
    beat: np.ndarray            # (H, W) float32, h
    beat_px: tuple[float, float]        # u, v
    beat_phase: float           # rad
    moved_px: tuple[float, float] = (0.0, 0.0)      # u, v

    def displacement(self, t: float) -> tuple[np.ndarray, np.ndarray]:
        """(H, W) float32 each: how far what moves stands off its place at `t` s, along u and v, px."""
        inhaled = self.breath_px * (1 - np.cos(2 * np.pi * BREATHS * t + self.breath_phase)) / 2
        pulse = np.sin(2 * np.pi * BEATS * t + self.beat_phase)
        u, v = (self.beat * np.float32(pulse * beat) + np.float32(moved)
                for beat, moved in zip(self.beat_px, self.moved_px))
        return u, v + self.breath * np.float32(inhaled)

    def at(self, t: float) -> np.ndarray:
        """(H, W) float32: the share of the beam that passes at `t` s."""
        h, w = self.breath.shape
        v, u = np.mgrid[0:h, 0:w].astype(np.float32) + np.float32(MARGIN_PX)
        aside, down = self.displacement(t)
        moving = cv2.remap(self.picture, u - aside, v - down, cv2.INTER_CUBIC)
        off = np.array([[1, 0, MARGIN_PX - self.moved_px[0]], [0, 1, MARGIN_PX - self.moved_px[1]]], np.float32)
        return np.maximum(moving, 0) * cv2.warpAffine(self.still, off, (w, h),
                                                      flags=cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP)

    def shifted(self, moved_px: tuple[float, float]) -> Breathing:
        """The same once the patient has moved by (u, v) px."""
        return dataclasses.replace(self, moved_px=tuple(map(float, moved_px)))


Patient = Callable[[int, float], Breathing]     # (plane 0 or 1, energy in keV) -> what it sees


def patient(rng: np.random.Generator, views: tuple[View, View], volume: ct.Volume | None = None) -> Patient:
    """What both planes see of one patient, who breathes and whose heart beats: a CT volume, that is projected once, or
    drawn anatomy. Raises ValueError as ct.path_lengths does."""
    phases, seed = tuple(rng.uniform(0, 2 * np.pi, 2)), int(rng.integers(2**31))
    if volume is None:
        return lambda i, energy_kev: _drawn(np.random.default_rng([seed, i]), views[i], energy_kev, phases)
    where = ct.draw_placement(rng, volume)
    lengths = [ct.path_lengths(volume, _larger(view), where) for view in views]
    return lambda i, energy_kev: _in_ct(np.random.default_rng([seed, i]), views[i],
                                        cv2.exp(-ct.optical_depth(lengths[i], energy_kev)), phases)


def _drawn(rng: np.random.Generator, view: View, energy_kev: float, phases: tuple[float, float]) -> Breathing:
    """Drawn tissue, ribs, vessels and a diaphragm that move, before a spine that is still; they attenuate as water
    does."""
    size, diaphragm = (view.height + 2 * MARGIN_PX, view.width + 2 * MARGIN_PX), rng.uniform(*DIAPHRAGM)
    picture = (anatomy.tissue(rng, size) * anatomy.ribs(rng, size) * anatomy.vessels(rng, size)
               * _dome(rng, size, MARGIN_PX + diaphragm * view.height))
    power = np.float32(rng.uniform(*DENSITY) * water_attenuation(energy_kev) / water_attenuation(REFERENCE_KEV))
    return Breathing(picture**power, anatomy.spine(rng, size)**power, **_moves(rng, view, diaphragm, phases))


def _in_ct(rng: np.random.Generator, view: View, picture: np.ndarray, phases: tuple[float, float]) -> Breathing:
    """The picture of a CT, pulled about as a breath would."""
    return Breathing(picture, np.ones_like(picture), **_moves(rng, view, rng.uniform(*DIAPHRAGM), phases))


def _larger(view: View) -> View:
    return View(view.name, view.P + np.outer([MARGIN_PX, MARGIN_PX, 0.0], view.P[2]), view.width + 2 * MARGIN_PX,
                view.height + 2 * MARGIN_PX)


def _moves(rng: np.random.Generator, view: View, diaphragm: float, phases: tuple[float, float]) -> dict:
    """Where and how far a breath and a beat move things; the diaphragm is at this share of the field's height."""
    h, w = view.height, view.width
    v, u = np.mgrid[0:h, 0:w].astype(np.float32)
    below = 1 / (1 + np.exp(-(v / h - diaphragm + 0.1) / 0.03))
    heart, turn = rng.uniform(0.3, 0.7, 2) * [w, h], rng.uniform(0, 2 * np.pi)
    beat = np.exp(-((u - heart[0])**2 + (v - heart[1])**2) / (2 * (HEART * w)**2))
    px = rng.uniform(*BEAT_PX)
    return dict(breath=(QUIET + (1 - QUIET) * below).astype(np.float32), breath_px=float(rng.uniform(*BREATH_PX)),
                breath_phase=float(phases[0]), beat=beat.astype(np.float32),
                beat_px=(float(px * np.cos(turn)), float(px * np.sin(turn))), beat_phase=float(phases[1]))


def _dome(rng: np.random.Generator, shape: tuple[int, int], top_px: float) -> np.ndarray:
    """(H, W) float32: what passes a diaphragm that arches up to row `top_px`, and the liver below."""
    h, w = shape
    v, u = np.mgrid[0:h, 0:w].astype(np.float32)
    edge = top_px + rng.uniform(0.2, 0.5) * h * (2 * u / w - rng.uniform(0.6, 1.4))**2
    depth = rng.uniform(*DOME) / (1 + np.exp(-np.clip((v - edge) / (rng.uniform(0.003, 0.008) * h), -30, 30)))
    return np.exp(-depth).astype(np.float32)
