"""Parameters: checked once, refused with name and reason."""

import pytest

from fluoro_shape_ros.config import Config, ConfigError, fields, visible_radius
from fluoro_shape_ros.device import REST, Device, Segment, load_device, presets


def test_defaults_pass_their_own_checks():
    assert Config.from_values(**Config().values()) == Config()


def test_every_parameter_is_described():
    for f in fields():
        assert len(f.metadata['description']) >= 10, f.name


def test_names_are_unique():
    names = [f.name for f in fields()]
    assert len(names) == len(set(names)) == len(Config().values())


def test_replace_keeps_the_rest():
    config = Config.from_values(robot_radius=0.001).replace(sync_slop=0.02)
    assert config.detection.robot_radius == 0.001 and config.input.sync_slop == 0.02


@pytest.mark.parametrize('name, value, reason', [
    ('robot_radius', -1.0, 'must lie in'), ('robot_radius', float('nan'), 'finite'), ('robot_radius', 'thin', 'number'),
    ('robot_radius', True, 'number'), ('polarity', 'grey', 'must be one of dark, bright, auto'),
    ('image_kind', 'mri', 'must be one of xray, silhouette'), ('image_kind', 1, 'needs a str'),
    ('min_confidence', 1.01, 'must lie in'), ('rectified', 1, 'needs a bool'), ('mask_frames', 0, 'must lie in'),
    ('mask_frames', 2.5, 'needs a int'), ('base_position', [1.0, 2.0], 'needs 0 or 3 numbers'),
    ('expected_length', [0.2, 0.1], 'min < max'), ('base_position', 5, 'needs a list of numbers, got 5'),
    ('expected_length', 'long', 'needs a list of numbers'), ('time_budget', -0.1, 'must lie in'),
    ('expected_length', [0.1, float('inf')], 'finite'), ('device', '/none.yaml', '/none.yaml: no such file'),
    ('device', 7, 'needs a str')])
def test_what_cannot_work_is_refused(name, value, reason):
    with pytest.raises(ConfigError, match=f'{name}.*{reason}'):
        Config.from_values(**{name: value})


def test_unknown_name_is_refused():
    with pytest.raises(ConfigError, match='no such parameter: robot_diameter'):
        Config.from_values(robot_diameter=0.001)


@pytest.mark.parametrize('value', [[], (0.1, 0.2)])
def test_lists_become_tuples(value):
    assert Config.from_values(expected_length=value).plausibility.expected_length == tuple(value)


# ---- the device that is described


def test_the_description_of_device_names_the_presets():
    description = next(f.metadata['description'] for f in fields() if f.name == 'device')
    assert f'{", ".join(presets())};' in description


@pytest.mark.parametrize('name', presets())
def test_the_radius_is_that_of_the_device_where_one_is_given(name):
    config = Config.from_values(device=name, robot_radius=0.003)
    assert config.described == load_device(name) and config.radius == visible_radius(config.described)
    assert config.values()['robot_radius'] == 0.003 and config.values()['device'] == name
    assert config.replace(polarity='bright').described is config.described
    assert config.replace(device='').radius == 0.003 and config.replace(device='').described is None


@pytest.mark.parametrize('lengths, radius', [((0.02, 0.04, REST), 2e-3), ((0.06, 0.01, REST), 3e-3),
                                             ((0.001, 0.001, REST), 1e-3), ((0.01, 0.03), 2e-3)])
def test_the_radius_is_the_one_that_most_images_show(lengths, radius):
    """The median over 0.1 m from the tip, of segments of 3, 2 and 1 mm."""
    device = Device(tuple(Segment(length, r, 'metal') for length, r in zip(lengths, (3e-3, 2e-3, 1e-3))))
    assert visible_radius(device) == radius


def test_a_file_is_read_when_the_parameter_is_given_and_not_again(tmp_path):
    path = tmp_path / 'mine.yaml'
    path.write_text('segments: [{length: rest, radius: 0.001, material: metal}]')
    config = Config.from_values(device=str(path))
    path.write_text('segments: [{length: rest, radius: 0.5, material: metal}]')
    assert config.replace(threads=1).radius == 0.001
    with pytest.raises(ConfigError, match=r'^device: .*mine.yaml: segments\[0\]: radius must lie in .*, got 0.5$'):
        config.replace(device=str(path))
