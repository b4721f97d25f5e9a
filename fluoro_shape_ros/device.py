"""What a device is made of, from its tip to its base: the file behind parameter `device`, and what the simulator draws.

    segments:                                   # from the tip; the last one may be `rest`
      - {length: 0.060, radius: 0.0007, lumen: 0.0005, material: metal}
      - {length: rest, radius: 0.0010, lumen: 0.0008, material: metal}
    bands:
      - {at: 0.002, length: 0.001, radius: 0.00075, material: platinum}

All lengths are in m; `at` is where a band begins, counted from the tip; `every` repeats it up to the base. Bands and
disks sit around the segment that they lie on and are as thick as they stand out. A lumen, like all that surrounds the
device, is filled with tissue or blood. Instead of a `material` there may be `attenuation`: 1/m, beyond that of tissue,
at REFERENCE_KEV.
"""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import yaml

from .resources import resource_path

REST = math.inf                     # length of a last segment that goes on to the base
REFERENCE_KEV = 60.0                # at which an attenuation given as a number holds
SHORTEST, LONGEST = 1e-5, 10.0      # m, of a part of a device
THINNEST, WIDEST = 1e-5, 0.01       # m, of a radius
CLOSEST = 1e-4                      # m, between bands and disks that repeat, all taken together
SLIVER = 1e-9                       # m: thinner is a rounding error
# bytes, entries, keys, brackets within one another
LARGEST_FILE, LARGEST_LIST, LARGEST_MAP, DEEPEST = 65536, 1000, 100, 20

# Mass attenuation coefficients in cm^2/g at ENERGIES_KEV (NIST XCOM), times density in g/cm^3, less that of the water
# that is displaced: 1/cm. Metal is nitinol with 55.8 % of nickel in its weight, polymer that of catheters: PEBAX with
# 10 % of barium sulfate.
ENERGIES_KEV = np.array([40.0, 50.0, 60.0, 80.0, 100.0])
WATER = np.array([0.2683, 0.2269, 0.2059, 0.1837, 0.1707])
_NITINOL = 6.45 * (0.558 * np.array([4.600, 2.474, 1.512, 0.7306, 0.4440])
                   + 0.442 * np.array([2.214, 1.213, 0.7661, 0.4052, 0.2721]))
_PLATINUM = 21.45 * np.array([12.45, 6.954, 4.339, 8.731, 4.993])
_PEBAX, _BARIUM_SULFATE = (np.array([0.2319, 0.2085, 0.1952, 0.1791, 0.1684]),
                           np.array([14.66, 8.252, 5.116, 2.414, 1.362]))
_POLYMER = 1.10 * (0.9 * _PEBAX + 0.1 * _BARIUM_SULFATE)
MATERIALS = {'metal': _NITINOL - WATER, 'platinum': _PLATINUM - WATER, 'polymer': _POLYMER - WATER}
# keV on either side, and 1/cm there
K_EDGES = {'platinum': ([78.39, 78.40], 21.45 * np.array([2.204, 9.373]) - 0.1850)}


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

    def __post_init__(self) -> None:
        if not self.segments:
            raise DeviceError('a device needs at least one segment')
        for k, s in enumerate(self.segments):
            where = f'segments[{k}]'
            _check_material(s.material, where)
            if not (SHORTEST <= s.length <= LONGEST or s.length == REST and k == len(self.segments) - 1):
                given = 'rest' if s.length == REST else f'{s.length:g}'
                raise DeviceError(f'{where}: length must lie in [{SHORTEST:g}, {LONGEST:g}] m, '
                                  f'or be `rest` in the last segment, got {given}')
            if not THINNEST <= s.radius <= WIDEST:
                raise DeviceError(f'{where}: radius must lie in [{THINNEST:g}, {WIDEST:g}] m, got {s.radius:g}')
            if not 0 <= s.lumen < s.radius:
                raise DeviceError(f'{where}: lumen, a radius in m, must lie in [0, radius), got {s.lumen:g}')
        for name, rings in (('bands', self.bands), ('disks', self.disks)):
            for k, r in enumerate(rings):
                self._check_ring(r, f'{name}[{k}]')
        if sum(1 / r.every for r in (*self.bands, *self.disks) if r.every) > 1 / CLOSEST:
            raise DeviceError(f'bands and disks: those that repeat (every) come more than once in {CLOSEST:g} m')

    def _check_ring(self, r: Ring, where: str) -> None:
        _check_material(r.material, where)
        if not 0 <= r.at <= LONGEST:
            raise DeviceError(f'{where}: at must lie in [0, {LONGEST:g}] m, got {r.at:g}')
        if not SHORTEST <= r.length <= LONGEST:
            raise DeviceError(f'{where}: length must lie in [{SHORTEST:g}, {LONGEST:g}] m, got {r.length:g}')
        if not THINNEST <= r.radius <= WIDEST:
            raise DeviceError(f'{where}: radius must lie in [{THINNEST:g}, {WIDEST:g}] m, got {r.radius:g}')
        if r.every and not r.length <= r.every <= LONGEST:
            raise DeviceError(f'{where}: every must lie in [length, {LONGEST:g}] m, got {r.every:g}')
        if r.at >= self.length:
            raise DeviceError(f'{where}: begins at {r.at:g} m from the tip, but the device is {self.length:g} m long')
        end = REST if r.every else r.at + r.length
        under = max(s.radius for _, _, s in _between(self._spans(end), r.at, end))
        if r.radius <= under:
            raise DeviceError(f'{where}: radius {r.radius:g} m does not stand out from the segment that it sits on, '
                              f'of {under:g} m')

    @property
    def radius(self) -> float:
        """What a user would give as robot_radius: half of the visible width at the tip, m."""
        return self.segments[0].radius

    @property
    def widest(self) -> float:
        """Largest radius of any part, m."""
        return max([*(s.radius for s in self.segments), *(r.radius for r in (*self.bands, *self.disks))])

    @property
    def length(self) -> float:
        """m; REST where the last segment goes on."""
        return sum(s.length for s in self.segments)

    def pieces(self, length: float) -> list[Piece]:
        """All parts of a device of which `length` m are there, from the tip; a `rest` ends there, and what the file has
        beyond does not count."""
        spans = self._spans(length)
        found = [Piece(start, stop, s.radius, s.lumen, s.material) for start, stop, s in spans]
        for ring in (*self.bands, *self.disks):
            for at in np.arange(ring.at, length, ring.every).tolist() if ring.every else [ring.at]:
                # a ring that lies across a joint is as thick on either side as it stands out there
                found += [Piece(start, stop, ring.radius, s.radius, ring.material)
                          for start, stop, s in _between(spans, at, at + ring.length)]
        return found

    def _spans(self, length: float) -> list[tuple[float, float, Segment]]:
        """Start, stop (m from the tip, at most `length`) and segment, of those that are there; the last one goes on to
        `length`."""
        spans, start = [], 0.0
        for k, s in enumerate(self.segments):
            stop = length if k == len(self.segments) - 1 else min(start + s.length, length)
            if stop - start > SLIVER:
                spans.append((start, stop, s))
            start = stop
        return spans


def _between(spans: list[tuple[float, float, Segment]], low: float, high: float) -> list[tuple[float, float, Segment]]:
    """What of `spans` lies from `low` to `high`, m from the tip."""
    return [(max(low, start), min(high, stop), s) for start, stop, s in spans
            if min(high, stop) - max(low, start) > SLIVER]


def attenuation(material: str | float, energy_kev: float) -> float:
    """1/m, beyond that of the tissue that is displaced, at an effective energy within ENERGIES_KEV; log-log between the
    tabulated ones.

    A number is that at REFERENCE_KEV, and falls with energy as that of metal does. Raises DeviceError for an energy
    beyond them.
    """
    if not isinstance(material, str):
        return float(material) * attenuation('metal', energy_kev) / attenuation('metal', REFERENCE_KEV)
    return _at_energy(MATERIALS[material], energy_kev, *K_EDGES.get(material, ((), ())))


def water_attenuation(energy_kev: float) -> float:
    """1/m, of water, soft tissue or blood."""
    return _at_energy(WATER, energy_kev)


def _at_energy(tabulated: np.ndarray, energy_kev: float, edge_kev: Sequence[float] = (),
               at_edge: Sequence[float] = ()) -> float:
    if not ENERGIES_KEV[0] <= energy_kev <= ENERGIES_KEV[-1]:
        raise DeviceError(f'attenuation is known from {ENERGIES_KEV[0]:g} to {ENERGIES_KEV[-1]:g} keV, '
                          f'not at {energy_kev:g} keV')
    k = np.searchsorted(ENERGIES_KEV, edge_kev)
    energies, values = np.insert(ENERGIES_KEV, k, edge_kev), np.insert(tabulated, k, at_edge)
    return float(100 * np.exp(np.interp(np.log(energy_kev), np.log(energies), np.log(values))))


def load_device(name: str | Path) -> Device:
    """The device of a YAML file: a path, or the name of a preset in the package's share (`cannula` or
    `device_cannula.yaml`).

    Raises DeviceError that names the file, and what in it is wrong.
    """
    path = _find(str(name))
    try:
        with path.open('rb') as file:
            text = file.read(LARGEST_FILE + 1)
        if len(text) > LARGEST_FILE:
            raise DeviceError(f'larger than {LARGEST_FILE} bytes')
        return device_from(_yaml(text))
    except OSError as error:
        raise DeviceError(f'{path}: can\'t be read: {error.strerror}') from error
    except DeviceError as error:
        raise DeviceError(f'{path}: {error}') from error


class _Loader(yaml.SafeLoader):
    """Refuses what can't be meant: a key that is there twice, of which one would be lost, and what takes YAML for
    ever."""

    def fetch_flow_collection_start(self, kind: Any) -> None:
        if self.flow_level >= DEEPEST:      # the scanner looks at all of them again for each token
            raise yaml.scanner.ScannerError(None, None, 'nested too deep', self.get_mark())
        super().fetch_flow_collection_start(kind)

    def compose_mapping_node(self, anchor: Any) -> Any:
        node = super().compose_mapping_node(anchor)
        keys = [key.value for key, _ in node.value if isinstance(key, yaml.ScalarNode)]
        if len(set(keys)) < len(keys):
            raise yaml.composer.ComposerError(None, None, f'{_brief(Counter(keys).most_common(1)[0][0])} is '
                                                          'there twice', node.start_mark)
        return node

    def flatten_mapping(self, node: Any) -> None:
        super().flatten_mapping(node)
        # in older PyYAML maps that merge others, and these others, grow exponentially
        if len(node.value) > LARGEST_MAP:
            raise yaml.constructor.ConstructorError(None, None, f'more than {LARGEST_MAP} keys', node.start_mark)


def _yaml(text: bytes) -> object:
    """The content of a YAML document. Raises DeviceError."""
    try:
        return yaml.load(text, _Loader)
    except yaml.MarkedYAMLError as error:
        what = ', '.join(filter(None, (error.context, error.problem)))
        raise DeviceError(f'not YAML: {_brief(what, 160)}, line {error.problem_mark.line + 1}') from error
    except RecursionError as error:
        raise DeviceError('not YAML: nested too deep') from error
    # what dates, tags and numbers that can't be raise in Python
    except (yaml.YAMLError, ValueError, LookupError, AttributeError, ArithmeticError) as error:
        raise DeviceError(f'not YAML: {_brief(" ".join(str(error).split()), 160)}') from error


def device_from(content: object) -> Device:
    """The device that a YAML file's content describes. Raises DeviceError that names what in it is wrong."""
    if isinstance(content, dict):
        _refuse_unknown(content, ('segments', 'bands', 'disks'), '')
    if not isinstance(content, dict) or not content.get('segments'):
        raise DeviceError('no device: a list `segments` is needed')
    segments = [_part(Segment, p, f'segments[{k}]') for k, p in enumerate(_listed(content, 'segments'))]
    bands, disks = ([_part(Ring, p, f'{name}[{k}]') for k, p in enumerate(_listed(content, name))]
                    for name in ('bands', 'disks'))
    return Device(tuple(segments), tuple(bands), tuple(disks))


def _listed(content: dict, name: str) -> list:
    parts = [] if content.get(name) is None else content[name]
    if not isinstance(parts, list):
        raise DeviceError(f'{name}: must be a list')
    if len(parts) > LARGEST_LIST:
        raise DeviceError(f'{name}: more than {LARGEST_LIST} entries')
    return parts


def _part(kind: Any, part: object, where: str) -> Any:
    """A Segment or Ring from its entry; `attenuation` stands in for `material`."""
    if not isinstance(part, dict):
        raise DeviceError(f'{where}: must be a map such as {{length: 0.01, radius: 0.0006, material: metal}}')
    given = dict(part)
    if ('material' in given) == ('attenuation' in given):
        raise DeviceError(f'{where}: needs either material or attenuation')
    material = given.pop('material') if 'material' in given else _number(given.pop('attenuation'),
                                                                         f'{where}: attenuation')
    if 'material' in part and not isinstance(material, str):
        raise DeviceError(f'{where}: material must be a name, got {_brief(material)}; a number is called attenuation')
    _refuse_unknown(given, [*(name for name in kind.__dataclass_fields__ if name != 'material'), 'material',
                            'attenuation'], f'{where}: ')
    required = {'length', 'radius'} if kind is Segment else {'at', 'length', 'radius'}
    if missing := required - given.keys():
        raise DeviceError(f'{where}: {", ".join(sorted(missing))} is missing')
    values = {name: REST if (kind, name, value) == (Segment, 'length', 'rest') else _number(value, f'{where}: {name}')
              for name, value in given.items()}
    return kind(material=material, **values)


def _number(value: Any, where: str) -> float:
    try:
        number = math.nan if isinstance(value, bool) else float(value)      # of text too: YAML 1.1 takes 1e-3 for text
    except (TypeError, ValueError, OverflowError):
        number = math.nan
    if not math.isfinite(number):
        raise DeviceError(f'{where} must be a number, got {_brief(value)}')
    return number


def _refuse_unknown(given: dict, known: Sequence[str], where: str) -> None:
    if unknown := sorted(_brief(key) for key in given if key not in known):
        raise DeviceError(f'{where}unknown: {", ".join(unknown[:3])}; there are {", ".join(known)}')


def _brief(value: object, most: int = 40) -> str:
    """`value` in a few words on one line, however long or deep it is."""
    if isinstance(value, (list, dict, set)):
        return {list: 'a list', dict: 'a map'}.get(type(value), 'a set')
    try:
        text = value if isinstance(value, str) and value.isprintable() else repr(value)
    except ValueError:      # of more digits than Python writes
        text = 'a huge number'
    return text if len(text) <= most else f'{text[:most]}...'


def _check_material(material: Any, where: str) -> None:
    if isinstance(material, str):
        if material not in MATERIALS:
            raise DeviceError(f'{where}: no material is called {_brief(material)}: there are {", ".join(MATERIALS)}, '
                              'or attenuation in 1/m')
    elif isinstance(material, bool) or not 0 < material < 1e6:
        raise DeviceError(f'{where}: attenuation must lie in (0, 1e6) 1/m, got {material:g}')


def _find(name: str) -> Path:
    """The file: as it is where it exists, else among the presets. Raises DeviceError."""
    try:
        path = Path(name).expanduser()
        if path.is_file():
            return path
        for preset in (name, f'{name}.yaml', f'device_{name}.yaml') if path.name == name else ():
            try:
                return resource_path(preset)
            except FileNotFoundError:
                continue
    except (OSError, RuntimeError):     # a name too long, a folder that may not be looked into, the home of nobody
        pass
    raise DeviceError(f'{_brief(name, 200)}: no such file, nor a device in the package\'s share; '
                      f'there are {", ".join(presets())}')


def presets() -> list[str]:
    """Names of the devices in the package's share."""
    folder = resource_path('device_rod.yaml').parent
    return sorted(p.stem.removeprefix('device_') for p in folder.glob('device_*.yaml'))
