"""What a device is made of, from its tip to its base: the file behind parameter `device`, and what the simulator draws.

    segments:                                   # from the tip; the last one may be `rest`
      - {length: 0.060, radius: 0.0007, lumen: 0.0005, material: metal}
      - {length: rest, radius: 0.0010, lumen: 0.0008, material: metal}
    bands:
      - {at: 0.002, length: 0.001, radius: 0.00075, material: platinum}

All lengths are in m; `at` is where a band begins, counted from the tip; `every` repeats it up to the base. Bands and disks sit around the segment
that they lie on and are as thick as they stand out. A lumen, like all that surrounds the device, is filled with tissue or blood.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import yaml

from .resources import resource_path

REST = math.inf                     # length of a last segment that goes on to the base
LONGEST, WIDEST = 10.0, 0.05        # m, of what can be a device

# Mass attenuation coefficients in cm^2/g at ENERGIES_KEV (NIST XCOM), times density in g/cm^3, less that of the water that is displaced: 1/cm.
# Polymer is that of catheters: PEBAX with 10 % of barium sulfate in its weight.
ENERGIES_KEV = np.array([40.0, 50.0, 60.0, 80.0, 100.0])
WATER = np.array([0.2683, 0.2269, 0.2059, 0.1837, 0.1707])
_NITINOL = 6.45 * (0.558 * np.array([4.600, 2.474, 1.512, 0.7306, 0.4440]) + 0.442 * np.array([2.214, 1.213, 0.7661, 0.4052, 0.2721]))
_PLATINUM = 21.45 * np.array([12.45, 6.954, 4.339, 8.731, 4.993])
_POLYMER = 1.12 * (0.0588 * np.array([24.57, 13.79, 8.511, 3.963, 2.196]) + 0.9412 * np.array([0.2275, 0.2084, 0.1970, 0.1823, 0.1719]))
MATERIALS = {'metal': _NITINOL - WATER, 'platinum': _PLATINUM - WATER, 'polymer': _POLYMER - WATER}


class DeviceError(ValueError):
    """A device that can't be, or a file that describes none; one line that names what and where."""


@dataclass(frozen=True)
class Segment:
    """A piece of the shaft: a cylinder, hollow where it has a lumen."""

    length: float                   # m; REST: up to the base
    radius: float                   # m
    material: str | float           # of MATERIALS, or 1/m beyond that of tissue
    lumen: float = 0.0              # m, radius; 0: solid


@dataclass(frozen=True)
class Ring:
    """A band or disk around the shaft."""

    at: float                       # m from the tip, where it begins
    length: float                   # m along the shaft
    radius: float                   # m, outer
    material: str | float           # of MATERIALS, or 1/m beyond that of tissue
    every: float = 0.0              # m, from one to the next; 0: one alone


@dataclass(frozen=True)
class Piece:
    """A hollow cylinder of one make about the backbone; a device is a sum of these."""

    start: float                    # m from the tip
    stop: float                     # m from the tip
    radius: float                   # m, outer
    lumen: float                    # m, inner radius; 0: solid
    material: str | float


@dataclass(frozen=True)
class Device:
    """Segments from the tip to the base, and what sits on them. Raises DeviceError for what can't be."""

    segments: tuple[Segment, ...]
    bands: tuple[Ring, ...] = ()
    disks: tuple[Ring, ...] = ()

    def __post_init__(self):
        if not self.segments:
            raise DeviceError('a device needs at least one segment')
        for k, s in enumerate(self.segments):
            where = f'segments[{k}]'
            _check_material(s.material, where)
            if not (0 < s.length <= LONGEST or s.length == REST and k == len(self.segments) - 1):
                raise DeviceError(f'{where}: length must lie in (0, {LONGEST:g}] m, or be `rest` in the last segment, got {s.length:g}')
            if not 0 < s.radius <= WIDEST:
                raise DeviceError(f'{where}: radius must lie in (0, {WIDEST:g}] m, got {s.radius:g}')
            if not 0 <= s.lumen < s.radius:
                raise DeviceError(f'{where}: lumen, a radius in m, must lie in [0, radius), got {s.lumen:g}')
        for name, rings in (('bands', self.bands), ('disks', self.disks)):
            for k, r in enumerate(rings):
                self._check_ring(r, f'{name}[{k}]')

    def _check_ring(self, r: Ring, where: str) -> None:
        _check_material(r.material, where)
        if not 0 <= r.at <= LONGEST:
            raise DeviceError(f'{where}: at must lie in [0, {LONGEST:g}] m, got {r.at:g}')
        if not 0 < r.length <= LONGEST:
            raise DeviceError(f'{where}: length must lie in (0, {LONGEST:g}] m, got {r.length:g}')
        if not 0 < r.radius <= WIDEST:
            raise DeviceError(f'{where}: radius must lie in (0, {WIDEST:g}] m, got {r.radius:g}')
        if r.every and not r.length <= r.every <= LONGEST:
            raise DeviceError(f'{where}: every must lie in [length, {LONGEST:g}] m, got {r.every:g}')
        if r.at >= self.length:
            raise DeviceError(f'{where}: begins at {r.at:g} m from the tip, but the device is {self.length:g} m long')
        under = [s for start, stop, s in self._spans(r.at + r.length) if start < r.at + r.length and stop > r.at]
        if any(r.radius <= s.radius for s in under):
            raise DeviceError(f'{where}: radius {r.radius:g} m does not stand out from the segment that it sits on, of {max(s.radius for s in under):g} m')

    @property
    def radius(self) -> float:
        """What a user would give as robot_radius: half of the visible width at the tip, m."""
        return self.segments[0].radius

    @property
    def widest(self) -> float:
        """Largest radius of any part, m."""
        return max(part.radius for part in (*self.segments, *self.bands, *self.disks))

    @property
    def length(self) -> float:
        """m; REST where the last segment goes on."""
        return sum(s.length for s in self.segments)

    def pieces(self, length: float) -> list[Piece]:
        """All parts of a device of which `length` m are there, from the tip; a `rest` ends there, and what the file has beyond does not count."""
        spans = self._spans(length)
        found = [Piece(start, stop, s.radius, s.lumen, s.material) for start, stop, s in spans]
        for ring in (*self.bands, *self.disks):
            for at in np.arange(ring.at, length, ring.every) if ring.every else [ring.at]:
                end = min(at + ring.length, length)
                # a ring that lies across a joint is as thick on either side as it stands out there
                found += [Piece(max(at, start), min(end, stop), ring.radius, s.radius, ring.material) for start, stop, s in spans if start < end and stop > at]
        return found

    def _spans(self, length: float) -> list[tuple[float, float, Segment]]:
        """Start, stop (m from the tip, at most `length`) and segment, of those that are there; the last one goes on to `length`."""
        spans, start = [], 0.0
        for k, s in enumerate(self.segments):
            stop = length if k == len(self.segments) - 1 else min(start + s.length, length)
            if stop > start:
                spans.append((start, stop, s))
            start = stop
        return spans


def attenuation(material: str | float, energy_kev: float) -> float:
    """1/m, beyond that of the tissue that is displaced, at an effective energy within ENERGIES_KEV; log-log between the tabulated ones."""
    if not isinstance(material, str):
        return float(material)
    return float(100 * np.exp(np.interp(np.log(energy_kev), np.log(ENERGIES_KEV), np.log(MATERIALS[material]))))


def load_device(name: str | Path) -> Device:
    """The device of a YAML file: a path, or the name of a preset in the package's share (`cannula` or `device_cannula.yaml`).

    Raises DeviceError that names the file, and what in it is wrong.
    """
    path = _find(str(name))
    try:
        content = yaml.safe_load(path.read_text(encoding='utf-8'))
    except (OSError, UnicodeDecodeError, yaml.YAMLError) as error:
        raise DeviceError(f'{path}: not a YAML file that can be read: {" ".join(str(error).split())}') from error
    try:
        return device_from(content)
    except DeviceError as error:
        raise DeviceError(f'{path}: {error}') from error


def device_from(content: object) -> Device:
    """The device that a YAML file's content describes. Raises DeviceError that names what in it is wrong."""
    if not isinstance(content, dict) or not content.get('segments'):
        raise DeviceError('no device: a list `segments` is needed')
    if unknown := set(content) - {'segments', 'bands', 'disks'}:
        raise DeviceError(f'unknown: {", ".join(sorted(map(str, unknown)))}; there are segments, bands, disks')
    segments = [_part(Segment, p, f'segments[{k}]') for k, p in enumerate(_listed(content, 'segments'))]
    bands, disks = ([_part(Ring, p, f'{name}[{k}]') for k, p in enumerate(_listed(content, name))] for name in ('bands', 'disks'))
    return Device(tuple(segments), tuple(bands), tuple(disks))


def _listed(content: dict, name: str) -> list:
    parts = content.get(name) or []
    if not isinstance(parts, list):
        raise DeviceError(f'{name}: must be a list')
    return parts


def _part(kind: type, part: object, where: str):
    """A Segment or Ring from its entry; `attenuation` stands in for `material`."""
    if not isinstance(part, dict):
        raise DeviceError(f'{where}: must be a map such as {{length: 0.01, radius: 0.0006, material: metal}}')
    given = dict(part)
    if ('material' in given) == ('attenuation' in given):
        raise DeviceError(f'{where}: needs either material or attenuation')
    material = given.pop('material') if 'material' in given else _number(given.pop('attenuation'), f'{where}: attenuation')
    names = kind.__dataclass_fields__.keys() - {'material'}
    required = {'length', 'radius'} if kind is Segment else {'at', 'length', 'radius'}
    if unknown := given.keys() - names:
        raise DeviceError(f'{where}: unknown: {", ".join(sorted(map(str, unknown)))}; there are {", ".join(sorted(names))}, material, attenuation')
    if missing := required - given.keys():
        raise DeviceError(f'{where}: {", ".join(sorted(missing))} is missing')
    values = {name: REST if (kind, name, value) == (Segment, 'length', 'rest') else _number(value, f'{where}: {name}') for name, value in given.items()}
    return kind(material=material, **values)


def _number(value: object, where: str) -> float:
    if isinstance(value, bool) or not isinstance(value, (int, float)) or not math.isfinite(value):
        raise DeviceError(f'{where} must be a number, got {value!r}')
    return float(value)


def _check_material(material: object, where: str) -> None:
    if isinstance(material, str) and material in MATERIALS:
        return
    if isinstance(material, (int, float)) and 0 < material < 1e6:
        return
    if isinstance(material, (int, float)):
        raise DeviceError(f'{where}: attenuation must lie in (0, 1e6) 1/m, got {material:g}')
    raise DeviceError(f'{where}: no material is called {material!r}: there are {", ".join(MATERIALS)}, or attenuation in 1/m')


def _find(name: str) -> Path:
    """The file: as it is where it has a folder or exists, else among the presets."""
    path = Path(name).expanduser()
    if path.is_file() or path.is_absolute():
        return path
    for preset in (name, f'{name}.yaml', f'device_{name}.yaml'):
        try:
            return resource_path(preset)
        except FileNotFoundError:
            continue
    raise DeviceError(f'{name}: no such file, nor a device in the package\'s share; there are {", ".join(presets())}')


def presets() -> list[str]:
    """Names of the devices in the package's share."""
    folder = resource_path('device_rod.yaml').parent
    return sorted(p.stem.removeprefix('device_') for p in folder.glob('device_*.yaml'))
