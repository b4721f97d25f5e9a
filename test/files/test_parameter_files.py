"""One table of parameter files, read by a real rclpy node and by the replay: what one takes, and what one refuses, the
other does, too."""

import pytest

from fluoro_shape_ros.config import Config, ConfigError
from fluoro_shape_ros.files.parameter_files import read_parameters
from fluoro_shape_ros.resources import resource_path

REFUSED = None


def section(name, *lines):
    return ''.join(f'{line}\n' for line in (f'{name}:', '  ros__parameters:', *(f'    {line}' for line in lines)))


def own(*lines):
    return section('fluoro_shape', *lines)


CASES = {   # name -> text of the file, and the parameters that are not at their default
    'all and own': (section('/**', 'spacing_px: 2.0') + own('spacing_px: 3.0'), dict(spacing_px=3.0)),
    'own and all': (own('spacing_px: 3.0', 'min_length_px: 7.0') + section('/**', 'spacing_px: 2.0'),
                    dict(spacing_px=2.0, min_length_px=7.0)),
    'all, own, all': (section('/**', 'spacing_px: 2.0') + own('spacing_px: 3.0')
                      + section('/**', 'spacing_px: 4.0', 'threads: 3'), dict(spacing_px=3.0, threads=3)),
    'own, all, own': (own('spacing_px: 3.0') + section('/**', 'spacing_px: 2.0') + own('threads: 3', 'spacing_px: 5.0'),
                      dict(spacing_px=2.0, threads=3)),
    'own twice': (own('spacing_px: 3.0') + own('spacing_px: 4.0'), dict(spacing_px=4.0)),
    'with a slash last': (own('spacing_px: 3.0') + section('/fluoro_shape', 'spacing_px: 4.0'), dict(spacing_px=4.0)),
    'with a slash first': (section('/fluoro_shape', 'spacing_px: 4.0') + own('spacing_px: 3.0'), dict(spacing_px=3.0)),
    'one star last': (own('spacing_px: 3.0') + section('/*', 'spacing_px: 2.0'), dict(spacing_px=2.0)),
    'a star without a slash': (section('"*"', 'spacing_px: 2.0'), dict(spacing_px=2.0)),
    'stars without a slash': (section('"**"', 'spacing_px: 2.0'), dict(spacing_px=2.0)),
    'any namespace': (section('/**/fluoro_shape', 'spacing_px: 2.0'), dict(spacing_px=2.0)),
    'any namespace, any name': (section('/**/*', 'spacing_px: 2.0'), dict(spacing_px=2.0)),
    'another node beside it': (own('spacing_px: 3.0') + section('driver', 'spacing_px: 2.0', 'x: [1]'),
                               dict(spacing_px=3.0)),
    'a namespace is another node': (own('threads: 3') + section('/lab/fluoro_shape', 'spacing_px: 2.0'),
                                    dict(threads=3)),
    'a namespace by nesting is another node': (own('threads: 3') + 'lab:\n  fluoro_shape:\n    ros__parameters:\n      '
                                                                   'spacing_px: 2.0\n', dict(threads=3)),
    'one name before it is another node': (own('threads: 3') + section('/*/fluoro_shape', 'spacing_px: 2.0'),
                                           dict(threads=3)),
    'the root by nesting': ('/:\n  fluoro_shape:\n    ros__parameters:\n      spacing_px: 2.0\n', dict(spacing_px=2.0)),
    'all by nesting': ('/**:\n  fluoro_shape:\n    ros__parameters:\n      spacing_px: 2.0\n', dict(spacing_px=2.0)),
    'two documents': (own('spacing_px: 3.0') + '---\n' + own('spacing_px: 4.0'), dict(spacing_px=4.0)),
    'one name twice': (own('spacing_px: 3.0', 'spacing_px: 4.0'), dict(spacing_px=4.0)),
    'of every node': (own('use_sim_time: true', 'qos_overrides: {/tip: {publisher: {depth: 3}}}', 'threads: 3'),
                      dict(threads=3)),
    'names that are unknown': (own('robot_radus: 0.001', 'threads: 3', 'frame.rate: 15'), dict(threads=3)),
    'nothing below': ('fluoro_shape:\n  ros__parameters: {}\n', {}),
    'whole for real': (own('spacing_px: 3'), dict(spacing_px=3.0)),
    'real for whole': (own('threads: 3.0'), REFUSED),
    'exponent': (own('robot_radius: 1e-3'), dict(robot_radius=0.001)),
    'large exponent': (own('max_curvature: 1E3'), dict(max_curvature=1000.0)),
    'no digit before the point': (own('sync_slop: .5'), dict(sync_slop=0.5)),
    'none after it': (own('spacing_px: 5.'), dict(spacing_px=5.0)),
    'signed': (own('threads: +5'), dict(threads=5)),
    'octal': (own('threads: 010'), dict(threads=8)),
    'no octal': (own('spacing_px: 08'), dict(spacing_px=8.0)),
    'hexadecimal': (own('threads: 0x10'), dict(threads=16)),
    'hexadecimal real': (own('sync_slop: 0x1p-3'), dict(sync_slop=0.125)),
    'underscore': (own('min_length_px: 1_000'), REFUSED),
    'sixties': (own('min_length_px: 1:30'), REFUSED),
    'quoted number': (own('robot_radius: "0.001"'), REFUSED),
    'once quoted number': (own("robot_radius: '0.001'"), REFUSED),
    'quoted numbers': (own('base_position: ["0.1", "0.2", "0.3"]'), REFUSED),
    'folded number': (own('robot_radius: >-', '  0.001'), dict(robot_radius=0.001)),
    'number with a comment': (own('robot_radius: 0.001 # m'), dict(robot_radius=0.001)),
    'endless': (own('max_tip_sigma: .inf'), REFUSED),
    'no number': (own('max_tip_sigma: .nan'), REFUSED),
    'beyond a double': (own('max_tip_sigma: 1e400'), REFUSED),
    'beyond an integer': (own('spacing_px: 99999999999999999999'), REFUSED),
    'yes': (own('rectified: yes'), dict(rectified=True)),
    'y': (own('rectified: y'), dict(rectified=True)),
    'Off': (own('tracking: Off'), dict(tracking=False)),
    'quoted bool': (own('tracking: "false"'), REFUSED),
    'number for bool': (own('tracking: 0'), REFUSED),
    'text that is a bool': (own('reference_frame: on'), REFUSED),
    'quoted text that is a bool': (own('reference_frame: "on"'), dict(reference_frame='on')),
    'text that is a number': (own('reference_frame: 5'), REFUSED),
    'quoted text that is a number': (own('reference_frame: "5"'), dict(reference_frame='5')),
    'null is text': (own('reference_frame: null'), dict(reference_frame='null')),
    'a date is text': (own('reference_frame: 2026-01-01'), dict(reference_frame='2026-01-01')),
    'empty text': (own('reference_frame: ""'), {}),
    'no value': (own('reference_frame:'), REFUSED),
    'list': (own('base_position: [0.1, 2e-1, .3]'), dict(base_position=(0.1, 0.2, 0.3))),
    'list of whole numbers': (own('base_position: [1, 2, 3]'), dict(base_position=(1.0, 2.0, 3.0))),
    'list of both': (own('base_position: [0.1, 0, 0.3]'), REFUSED),
    'list with a word': (own('base_position: [0.1, 0.2, x]'), REFUSED),
    'scalar for a list': (own('base_position: 5'), REFUSED),
    'empty list': (section('/**', 'base_position: [0.1, 0.2, 0.3]') + own('base_position: []'), {}),
    'list for a scalar': (own('robot_radius: [0.001]'), REFUSED),
    'aliases': (own('spacing_px: &x 3.0', 'min_length_px: *x'), REFUSED),
    'no section': ('spacing_px: 3.0\n', REFUSED),
    'a list of sections': ('- spacing_px\n', REFUSED),
    'a null section': ('fluoro_shape:\n  ros__parameters:\n', REFUSED),
    'a node beside its parameters': (section('/**', 'threads: 3')
                                     + '  fluoro_shape:\n    ros__parameters:\n      threads: 4\n', REFUSED),
    'something after it': (own('threads: 3') + 'foo: 1\n', REFUSED),
    'no name of a node': (own('threads: 3') + section('fluoro-shape', 'threads: 4'), REFUSED),
    'tabs': ('fluoro_shape:\n\tros__parameters:\n', REFUSED),
}


def not_default(config):
    return {name: value for name, value in config.values().items() if value != Config().values()[name]}


@pytest.mark.parametrize('case', CASES)
def test_replay(tmp_path, case):
    text, taken = CASES[case]
    (tmp_path / 'my.yaml').write_text(text)
    read = lambda: not_default(Config.from_values(**read_parameters(str(tmp_path / 'my.yaml'))))       # noqa: E731
    if taken is REFUSED:
        with pytest.raises(ConfigError) as error:
            read()
        assert '\n' not in str(error.value)
    else:
        assert read() == taken


@pytest.mark.parametrize('case', CASES)
def test_node(tmp_path, case):
    """The same by the parser of ROS, and the node's own declaration."""
    rclpy = pytest.importorskip('rclpy')
    from rclpy.context import Context

    from fluoro_shape_ros.ros import parameters as params
    text, taken = CASES[case]
    (tmp_path / 'my.yaml').write_text(text)
    context, node, got = Context(), None, REFUSED
    try:
        rclpy.init(args=['--ros-args', '--params-file', str(tmp_path / 'my.yaml')], context=context, domain_id=61)
        node = rclpy.create_node('fluoro_shape', context=context, start_parameter_services=False, enable_rosout=False)
        got = not_default(params.declare(node))
    except (RuntimeError, ConfigError):
        pass
    finally:
        if node is not None:
            node.destroy_node()
        rclpy.try_shutdown(context=context)
    assert got == taken


def test_on_the_command_line(tmp_path):
    """The same words, and they win; whole and real numbers may be mixed there."""
    (tmp_path / 'my.yaml').write_text(own('threads: 3', 'spacing_px: 3.0'))
    values = read_parameters(str(tmp_path / 'my.yaml'), ['threads:=010', 'tracking=off', 'base_position=[0, 1e-1, .2]',
                                                         'expected_length=[]', 'reference_frame=null'])
    assert values == dict(threads=8, spacing_px=3.0, tracking=False, base_position=(0, 0.1, 0.2), expected_length=(),
                          reference_frame='null')


def test_a_file_of_other_nodes_says_of_which(tmp_path):
    (tmp_path / 'my.yaml').write_text(section('/lab/fluoro_shape', 'threads: 3') + section('driver', 'x: 1'))
    with pytest.raises(ConfigError, match=r'my.yaml: no ros__parameters of fluoro_shape \(nor of /\*\*\), '
                                          r'but of /lab/fluoro_shape, driver$'):
        read_parameters(str(tmp_path / 'my.yaml'))


def test_names_that_are_unknown_are_told_with_the_nearest_that_is_known(tmp_path):
    (tmp_path / 'my.yaml').write_text(own('robot_radus: 0.001', 'threads: 3'))
    said = []
    assert read_parameters(str(tmp_path / 'my.yaml'), (), said.append) == dict(threads=3)
    assert said == [f'{tmp_path / "my.yaml"}: there is no parameter robot_radus, but robot_radius']


@pytest.mark.parametrize('name', ['defaults.yaml', 'preset_needle.yaml', 'preset_catheter.yaml',
                                  'preset_concentric_tube.yaml'])
def test_files_that_are_installed(name):
    said = []
    Config.from_values(**read_parameters(str(resource_path(name)), (), said.append))
    assert said == []
