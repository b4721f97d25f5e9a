"""Who may know whom: the imports of every module against the tables of docs/architecture.md."""

import ast
import re
from dataclasses import dataclass
from fnmatch import fnmatchcase
from graphlib import TopologicalSorter
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[1]
PAGE = (ROOT / 'docs' / 'architecture.md').read_text(encoding='utf-8')
PACKAGES = 'fluoro_shape_ros', 'msg_adapters'
ROS = {'rclpy', 'tf2_ros', 'builtin_interfaces', 'diagnostic_msgs', 'geometry_msgs', 'nav_msgs', 'rcl_interfaces',
       'sensor_msgs', 'std_msgs', 'std_srvs', 'visualization_msgs'}


@dataclass(frozen=True)
class Room:
    """A row of the page's table of rooms."""

    files: tuple[str, ...]      # patterns
    known: frozenset[str]       # rooms
    ros: bool                   # whether it may import ROS


def cells(marker: str) -> list[list[str]]:
    """The rows of the page's table between <!-- marker --> and <!-- /marker -->, without its head."""
    table = PAGE.split(f'<!-- {marker} -->\n')[1].split(f'<!-- /{marker} -->')[0]
    return [[cell.strip() for cell in line.strip('| ').split('|')] for line in table.strip().splitlines()[2:]]


def named(cell: str) -> tuple[str, ...]:
    """What stands in `code` in a cell."""
    return tuple(re.findall('`([^`]+)`', cell))


ROOMS = {name: Room(named(files), frozenset(known.split()), ros == 'yes')
         for name, files, known, ros, _ in cells('directions')}
EXCEPTIONS = {(named(file)[0], other) for file, others, _ in cells('exceptions') for other in named(others)}


def short(path: str) -> str:
    """A module's file as the page names it."""
    return path.removeprefix('fluoro_shape_ros/')


def sources() -> dict[str, str]:
    """The text of every module by its file, as the page names it."""
    return {short(path.relative_to(ROOT).as_posix()): path.read_text(encoding='utf-8') for package in PACKAGES
            for path in (ROOT / package).rglob('*.py')}


def imported(file: str, source: str) -> set[str]:
    """The dotted names that a module imports anywhere in it; of `from a import b` both a and a.b."""
    package = [*([] if file.startswith('msg_adapters/') else ['fluoro_shape_ros']), *file.split('/')[:-1]]
    found = set()
    for node in ast.walk(ast.parse(source)):
        if isinstance(node, ast.Import):
            found |= {alias.name for alias in node.names}
        elif isinstance(node, ast.ImportFrom):
            base = '.'.join([*(package[:len(package) - node.level + 1] if node.level else []),
                             *filter(None, [node.module])])
            found |= {base, *(f'{base}.{alias.name}' for alias in node.names)}
    return found


def rooms_of(file: str, rooms: dict[str, Room]) -> list[str]:
    """The rooms that name a file, else those with a pattern that it fits."""
    return ([name for name, room in rooms.items() if file in room.files]
            or [name for name, room in rooms.items() if any(fnmatchcase(file, p) for p in room.files)])


def broken(modules: dict[str, str], rooms: dict[str, Room]) -> set[tuple[str, str]]:
    """File and what it imports, where its room may not know that one's; a package's __init__ may know nothing."""
    found = set()
    for file, source in modules.items():
        known = set() if file.endswith('__init__.py') else {r for name in rooms_of(file, rooms)
                                                            for r in (name, *rooms[name].known)}
        others = {short(f'{name.replace(".", "/")}.py') for name in imported(file, source)} & modules.keys()
        found |= {(file, other) for other in others if not known.intersection(rooms_of(other, rooms))}
    return found


def test_every_module_is_in_one_room_and_no_row_is_out_of_date():
    files = [file for file in sources() if not file.endswith('__init__.py')]
    assert {file: found for file in files if len(found := rooms_of(file, ROOMS)) != 1} == {}
    assert [pattern for room in ROOMS.values() for pattern in room.files
            if not any(fnmatchcase(file, pattern) for file in files)] == []
    assert {name for room in ROOMS.values() for name in room.known} <= ROOMS.keys()


def test_imports_go_the_ways_of_the_page_but_for_what_it_lists():
    found = broken(sources(), ROOMS)
    assert found - EXCEPTIONS == set(), 'against the directions of docs/architecture.md'
    assert EXCEPTIONS - found == set(), 'mended: take them off the page'


def test_the_directions_have_no_circle():
    TopologicalSorter({name: room.known for name, room in ROOMS.items()}).prepare()     # raises CycleError


def test_only_the_ends_import_ros():
    found = {file for file, source in sources().items()
             if {name.partition('.')[0] for name in imported(file, source)} & ROS}
    assert [file for file in sorted(found) if not any(ROOMS[name].ros for name in rooms_of(file, ROOMS))] == []
    assert ({name for file in found for name in rooms_of(file, ROOMS)}
            == {name for name, room in ROOMS.items() if room.ros})


HOUSE = {'ground': Room(('data.py',), frozenset(), False),
         'adapters': Room(('msg_adapters/*',), frozenset(['ground']), False),
         'fit': Room(('method/fit/*',), frozenset(['ground']), False)}


@pytest.mark.parametrize('file, source, others', [
    ('method/fit/a.py', 'from ...data import x\nfrom .b import y', []),
    ('method/fit/a.py', 'from . import b', []),
    ('msg_adapters/a.py', 'from fluoro_shape_ros.data import x', []),
    ('data.py', 'from .method.fit import b', ['method/fit/b.py']),
    ('data.py', 'from .method.fit.b import x', ['method/fit/b.py']),
    ('data.py', 'import fluoro_shape_ros.method.fit.b as b', ['method/fit/b.py']),
    ('data.py', 'def f():\n    from msg_adapters import images', ['msg_adapters/images.py']),
    ('method/fit/a.py', 'import msg_adapters.images', ['msg_adapters/images.py']),
    ('msg_adapters/a.py', 'from .images import x\nfrom fluoro_shape_ros.method.fit.b import y', ['method/fit/b.py']),
    ('method/fit/__init__.py', 'from .b import x', ['method/fit/b.py']),
])
def test_what_goes_another_way_is_found(file, source, others):
    modules = {'data.py': '', 'method/fit/b.py': '', 'msg_adapters/images.py': ''} | {file: source}
    assert broken(modules, HOUSE) == {(file, other) for other in others}
