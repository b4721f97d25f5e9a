"""Parameters on a real rclpy node (no executor, no traffic)."""


import pytest

rclpy = pytest.importorskip('rclpy')

from rcl_interfaces.msg import ParameterType
from rclpy.context import Context
from rclpy.parameter import Parameter

from fluoro_shape_ros.config import Config, ConfigError, fields
from fluoro_shape_ros.ros import parameters as params


@pytest.fixture(scope='module')
def context():
    context = Context()
    rclpy.init(context=context, domain_id=61)
    yield context
    rclpy.shutdown(context=context)


@pytest.fixture
def make(context):
    """A node whose overrides are given as keyword arguments."""
    nodes = []

    def make(**overrides):
        given = [Parameter(name, value=value) for name, value in overrides.items()]
        nodes.append(rclpy.create_node('params_test', context=context, parameter_overrides=given,
                                       start_parameter_services=False))
        return nodes[-1]

    yield make
    for node in nodes:
        node.destroy_node()


def test_defaults_are_those_of_the_config(make):
    node = make()
    assert params.declare(node) == Config()
    for f in fields():
        value = node.get_parameter(f.name).value
        assert (tuple(value) if f.metadata['element'] else value) == f.default


@pytest.mark.parametrize('name, given, taken', [
    ('robot_radius', 0.001, 0.001),
    ('sync_slop', 1, 1.0),                              # a whole number for a real one
    ('base_position', [0.1, 0.2, 0.3], (0.1, 0.2, 0.3)),
    ('base_position', [1, 2, 3], (1.0, 2.0, 3.0)),
    ('base_position', [], ()),
    ('base_position', None, ()),                        # what `-p base_position:=[]` arrives as
    ('threads', 0, 0),
    ('reference_frame', 'cell', 'cell'),
    ('device', 'ep', 'ep'),
    ('tracking', False, False),
    ('image_kind', 'silhouette', 'silhouette'),
])
def test_overrides_are_taken(make, name, given, taken):
    node = make(**{name: given})
    config = params.declare(node)
    assert config.values()[name] == taken
    value = node.get_parameter(name).value
    assert (tuple(value) if isinstance(taken, tuple) else value) == taken


@pytest.mark.parametrize('name, given, reason', [
    ('robot_radius', -1.0, 'robot_radius: must lie in'),
    ('robot_radius', 'thin', 'robot_radius: needs a finite number'),
    ('base_position', [0.0, 1.0], 'base_position: needs 0 or 3 numbers, got 2'),
    ('polarity', 'grey', 'polarity: must be one of dark, bright, auto'),
    ('image_kind', 'mri', "image_kind: must be one of xray, silhouette, got 'mri'"),
    ('threads', 2.0, 'threads: needs a int'),
    ('tracking', 1, 'tracking: needs a bool'),
    ('tracking', 'true', 'tracking: needs a bool'),     # as a quoted one comes
    ('base_position', 5, 'base_position: needs a list of numbers, got 5'),
    ('time_budget', -1.0, 'time_budget: must lie in [0, 60] s'),
    ('device', '/none.yaml', 'device: /none.yaml: no such file'),
    ('qos_overrides./backbone.publisher.depth', 'abc', 'depth: needs a whole number from 0'),
    ('qos_overrides./backbone.publisher.depth', -3, 'depth: needs a whole number from 0'),
    ('qos_overrides./plane_a/image_raw.subscription.depth', True, 'depth: needs a whole number from 0'),
    ('qos_overrides./backbone.publisher.reliability', 5, 'reliability: must be one of'),
    ('qos_overrides./backbone.publisher.reliability', 'auto', 'reliability: must be one of'),
    ('qos_overrides./backbone.publisher.history', [1, 2], 'history: must be one of'),
    ('qos_overrides./plane_a/camera_info.subscription.durability', 'maybe',
     'durability: must be one of system_default, transient_local, volatile'),
])
def test_unusable_overrides_are_refused_by_name(make, name, given, reason):
    with pytest.raises(ConfigError) as error:
        params.declare(make(**{name: given}))
    assert reason in str(error.value)


def test_qos_overrides_that_can_work_are_let_through(make):
    given = {'backbone.publisher.depth': 3, 'plane_a/image_raw.subscription.reliability': 'auto',
             'tip.publisher.reliability': 'best_effort',
             'plane_a/image_raw.subscription.history': 'keep_all', 'backbone.publisher.deadline': 'some time'}
    assert params.declare(make(**{f'qos_overrides./{name}': value for name, value in given.items()})) == Config()


def test_a_name_that_is_unknown_is_told_with_the_nearest_that_is_known(make):
    node = make(robot_radus=0.001, polarity='bright', use_sim_time=False, zzz=1)
    params.declare(node)
    assert params.unknown(node) == 'there is no parameter robot_radus, but robot_radius; there is no parameter zzz'
    node = make(robot_radius=0.001)
    params.declare(node)
    assert params.unknown(node) == ''


def test_descriptors_say_what_the_config_knows(make):
    node = make()
    params.declare(node)
    for f in fields():
        d = node.describe_parameter(f.name)
        assert (f.metadata['description'] in d.description and f.metadata['unit'] in d.description
                and not d.dynamic_typing)
        assert all(choice in d.additional_constraints for choice in f.metadata['choices'])
        ranges = [*d.floating_point_range, *d.integer_range]
        assert ([(r.from_value, r.to_value) for r in ranges]
                == ([] if f.metadata['low'] is None else [(f.metadata['low'], f.metadata['high'])]))
    assert node.describe_parameter('base_position').type == ParameterType.PARAMETER_DOUBLE_ARRAY
    assert node.describe_parameter('base_position').additional_constraints == 'none or 3 numbers'
    assert node.describe_parameter('expected_length').additional_constraints == 'none or 2 numbers, 0 <= min < max'
    assert node.describe_parameter('robot_radius').type == ParameterType.PARAMETER_DOUBLE
    assert node.describe_parameter('threads').type == ParameterType.PARAMETER_INTEGER


def test_a_change_keeps_everything_else():
    config = params.changed(Config.from_values(polarity='bright'),
                            [Parameter('base_position', value=[1.0, 2.0, 3.0]), Parameter('use_sim_time', value=True)])
    assert config == Config.from_values(polarity='bright', base_position=(1.0, 2.0, 3.0))


def test_a_change_that_cannot_work_raises():
    with pytest.raises(ConfigError, match='expected_length: needs 0 <= min < max'):
        params.changed(Config(), [Parameter('expected_length', value=[0.2, 0.1])])
    with pytest.raises(ConfigError, match='device: none: no such file'):
        params.changed(Config(), [Parameter('device', value='none')])


@pytest.mark.parametrize('given, taken', [
    (Parameter('robot_radius', value=1), (Parameter.Type.DOUBLE, 1.0)),
    (Parameter('base_position', value=[1, 2, 3]), (Parameter.Type.DOUBLE_ARRAY, [1.0, 2.0, 3.0])),
    (Parameter('base_position', Parameter.Type.BOOL_ARRAY, []), (Parameter.Type.DOUBLE_ARRAY, [])),
    (Parameter('base_position', value=['x']), (Parameter.Type.STRING_ARRAY, ['x'])),   # left for the node to refuse
    (Parameter('robot_radius', value='x'), (Parameter.Type.STRING, 'x')),
    (Parameter('threads', value=3), (Parameter.Type.INTEGER, 3)),
    (Parameter('use_sim_time', value=True), (Parameter.Type.BOOL, True)),
])
def test_types_become_the_declared_ones(given, taken):
    out, = params.as_declared([given])
    assert out.name == given.name and (out.type_, out.value) == taken


