"""What must agree across files, what must work without ROS, and what every executable does with --help and nonsense."""

import json
import re
import runpy
import subprocess
import sys
import types
import xml.etree.ElementTree as ElementTree
from pathlib import Path

import pytest

import fluoro_shape_ros
from fluoro_shape_ros import resources
from fluoro_shape_ros.config import constraint, fields
from fluoro_shape_ros.data import Outcome

ROOT = Path(__file__).resolve().parents[1]
PARAMETERS = ROOT / 'docs' / 'parameters.md'
PROFILE = 'fastdds_large_images.xml'


def read_setup() -> dict:
    """What setup.py tells setuptools, which need not be installed."""
    given = {}
    stand_in = types.SimpleNamespace(setup=lambda **keywords: given.update(keywords), find_packages=lambda **_: [])
    with pytest.MonkeyPatch.context() as patch:
        patch.chdir(ROOT)
        patch.setitem(sys.modules, 'setuptools', stand_in)
        runpy.run_path('setup.py')
    return given


METADATA = read_setup()
EXECUTABLES = {name: target.removesuffix(':main')
               for name, target in (line.split(' = ') for line in METADATA['entry_points']['console_scripts'])}


@pytest.fixture(scope='module')
def manifest():
    return ElementTree.parse(ROOT / 'package.xml').getroot()


# ---- files that must agree


def test_package_xml_and_setup_py_agree(manifest):
    for tag in ('name', 'version', 'description', 'license'):
        assert manifest.findtext(tag) == METADATA[tag], tag
    assert manifest.find('maintainer').get('email') == METADATA['maintainer_email']
    assert manifest.get('format') == '3' and manifest.findtext('export/build_type') == 'ament_python'


def test_every_python_dependency_is_a_rosdep_dependency(manifest):
    keys = {'numpy': 'python3-numpy', 'pyyaml': 'python3-yaml', 'scipy': 'python3-scipy',
            'opencv-python-headless': 'python3-opencv', 'scikit-image': 'python3-skimage', 'tqdm': 'python3-tqdm'}
    required = {requirement.split('>')[0] for requirement in METADATA['install_requires']}
    assert required == set(keys)
    assert {keys[name] for name in required} <= {e.text for e in manifest.findall('exec_depend')}


def test_data_files_exist_and_ros2_run_finds_every_executable():
    files = dict(METADATA['data_files'])
    for names in files.values():
        for name in names:
            assert (ROOT / name).is_file(), name
    stubs = {Path(name).name: (ROOT / name).read_text() for name in files['lib/fluoro_shape_ros']}
    assert set(stubs) == set(EXECUTABLES)
    for name, text in stubs.items():
        assert (f' -m {EXECUTABLES[name]} ' in text
                and (ROOT / 'resource/bin' / name).stat().st_mode & 0o111 == 0o111), name
    assert f'resource/{PROFILE}' in files['share/fluoro_shape_ros']


def test_the_version_moves_with_the_changelog(manifest):
    headings = re.findall(r'^(.+)\n-+$', (ROOT / 'CHANGELOG.rst').read_text(encoding='utf-8'), re.MULTILINE)
    releases = [re.fullmatch(r'(\d+\.\d+\.\d+) \(\d{4}-\d\d-\d\d\)', heading)
                for heading in headings[headings[0] == 'Forthcoming':]]
    assert all(releases), headings
    newest = releases[0][1] if releases else '0.1.0'        # that of the first release, before there is one
    assert METADATA['version'] == manifest.findtext('version') == fluoro_shape_ros.__version__ == newest


def test_the_page_of_parameters_lists_every_one_as_it_is():
    text = PARAMETERS.read_text(encoding='utf-8')
    shown = text.split('<!-- parameters -->\n')[1].split('<!-- /parameters -->')[0]
    assert shown.strip() == parameter_table(), 'python test/test_package.py writes the table'


def test_the_file_of_defaults_is_true():
    assert resources.resource_path('defaults.yaml').read_text() == defaults_file(), ('python test/test_package.py '
                                                                                     'writes it')


def test_troubleshooting_names_every_rejection():
    text = (ROOT / 'docs' / 'troubleshooting.md').read_text(encoding='utf-8')
    assert [o.value for o in Outcome if o is not Outcome.OK and f'`{o.value}' not in text] == []


def parameter_table() -> str:
    """The table of docs/parameters.md."""
    rows = ['| parameter | default | unit | range | what it is |', '|---|---|---|---|---|']
    for f in fields():
        m = f.metadata
        rows.append(f'| `{f.name}` | `{_default(f)}` | {m["unit"]} | {_range(f).removeprefix("one of: ")} | '
                    f'{m["description"]} |')
    return '\n'.join(rows)


def defaults_file() -> str:
    """resource/defaults.yaml."""
    lines = ['# Every parameter of fluoro_shape_node with its default: '
             'copy, change, and give it with `--ros-args --params-file`.',
             '# Made from config.py. `/**` means: whatever the namespace of the node is.', '/**:', '  ros__parameters:']
    for f in fields():
        notes = ', '.join(filter(None, (f.metadata['unit'], _range(f))))
        lines += [f'    # {f.metadata["description"]}' + (f' ({notes})' if notes else ''),
                  f'    {f.name}: {_default(f)}']
    return '\n'.join(lines) + '\n'


def _default(f) -> str:
    return json.dumps(list(f.default) if f.metadata['element'] else f.default)


def _range(f) -> str:
    m = f.metadata
    return constraint(f) or ('' if m['low'] is None else f'{m["low"]:g} to {m["high"]:g}')


# ---- resources


def test_the_profile_is_found_and_has_room_for_megapixel_images():
    ns = {'d': 'http://www.eprosima.com/XMLSchemas/fastRTPS_Profiles'}
    profiles = ElementTree.parse(resources.resource_path(PROFILE)).getroot().find('d:profiles', ns)
    transports = {t.findtext('d:transport_id', None, ns): t
                  for t in profiles.findall('d:transport_descriptors/d:transport_descriptor', ns)}
    rtps = profiles.find('d:participant[@is_default_profile="true"]/d:rtps', ns)
    used = [t.text for t in rtps.findall('d:userTransports/d:transport_id', ns)]
    assert sorted(transports[name].findtext('d:type', None, ns) for name in used) == ['SHM', 'UDPv4']
    assert rtps.findtext('d:useBuiltinTransports', None, ns) == 'false'
    shm = next(t for t in transports.values() if t.findtext('d:type', None, ns) == 'SHM')
    assert int(shm.findtext('d:segment_size', None, ns)) == 32 * 2**20
    assert int(shm.findtext('d:maxMessageSize', None, ns)) == 16 * 2**20


def test_a_missing_resource_is_named():
    with pytest.raises(FileNotFoundError, match='nowhere.xml'):
        resources.resource_path('nowhere.xml')


# ---- without ROS

WITHOUT_ROS = '''
import sys
BLOCKED = {'rclpy', 'sensor_msgs', 'nav_msgs', 'geometry_msgs', 'std_msgs', 'std_srvs',
           'diagnostic_msgs', 'visualization_msgs', 'builtin_interfaces', 'rcl_interfaces'}
class Blocker:
    def find_spec(self, name, path=None, target=None):
        if name.split('.')[0] in BLOCKED:
            raise ModuleNotFoundError(f"No module named '{name}'", name=name)
sys.meta_path.insert(0, Blocker())
'''


def python(code, *arguments):
    return subprocess.run([sys.executable, '-c', code, *arguments], capture_output=True, text=True, timeout=60)


@pytest.mark.parametrize('module', ['fluoro_shape_ros.method.pipeline', 'fluoro_shape_ros.sim.scenes',
                                    'msg_adapters.images', 'msg_adapters.shapes', 'msg_adapters.bags',
                                    *sorted(EXECUTABLES.values())])
def test_imports_without_ros(module):
    done = python(f'{WITHOUT_ROS}\nimport importlib, sys\nimportlib.import_module(sys.argv[1])', module)
    assert done.returncode == 0, done.stderr


@pytest.mark.parametrize('name', ['fluoro_shape_node', 'fluoro_shape_sim', 'fluoro_shape_demo',
                                  'fluoro_shape_servo_demo'])
def test_what_needs_ros_says_so_in_one_line(name):
    done = python(f'{WITHOUT_ROS}\nimport importlib, sys\nsys.exit(importlib.import_module(sys.argv[1]).main([]))',
                  EXECUTABLES[name])
    assert done.returncode == 1
    assert (done.stderr.count('\n') == 1 and done.stderr.startswith(name) and 'rclpy' in done.stderr
            and 'fluoro_shape_ros[ros]' in done.stderr), done.stderr


# ---- executables


@pytest.mark.parametrize('name', sorted(EXECUTABLES))
def test_help_and_nonsense(name):
    run = [sys.executable, '-m', EXECUTABLES[name]]
    done = subprocess.run([*run, '--help'], capture_output=True, text=True, timeout=60)
    assert done.returncode == 0 and done.stdout.startswith(f'usage: {name}') and not done.stderr, done.stderr
    done = subprocess.run([*run, '--no-such-option'], capture_output=True, text=True, timeout=60)
    assert done.returncode == 2 and name in done.stderr and 'Traceback' not in done.stderr, done.stderr


if __name__ == '__main__':
    before, rest = PARAMETERS.read_text(encoding='utf-8').split('<!-- parameters -->\n')
    after = rest.split('<!-- /parameters -->')[1]
    PARAMETERS.write_text(f'{before}<!-- parameters -->\n{parameter_table()}\n<!-- /parameters -->{after}',
                          encoding='utf-8')
    (ROOT / 'resource' / 'defaults.yaml').write_text(defaults_file())
