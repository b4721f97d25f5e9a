"""Parameters: checked once, refused with name and reason."""

import pytest

from fluoro_shape_ros.config import Config, ConfigError, fields


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
    ('robot_radius', -1.0, 'must lie in'), ('robot_radius', float('nan'), 'finite'), ('robot_radius', 'thin', 'number'), ('robot_radius', True, 'number'),
    ('polarity', 'grey', 'must be one of dark, bright, auto'), ('min_confidence', 1.01, 'must lie in'), ('rectified', 1, 'needs a bool'), ('mask_frames', 0, 'must lie in'),
    ('mask_frames', 2.5, 'needs a int'), ('base_position', [1.0, 2.0], 'needs 0 or 3 numbers'), ('expected_length', [0.2, 0.1], 'min < max'),
    ('base_position', 5, 'needs a list of numbers, got 5'), ('expected_length', 'long', 'needs a list of numbers'), ('time_budget', -0.1, 'must lie in'),
    ('expected_length', [0.1, float('inf')], 'finite')])
def test_what_cannot_work_is_refused(name, value, reason):
    with pytest.raises(ConfigError, match=f'{name}.*{reason}'):
        Config.from_values(**{name: value})


def test_unknown_name_is_refused():
    with pytest.raises(ConfigError, match='no such parameter: robot_diameter'):
        Config.from_values(robot_diameter=0.001)


@pytest.mark.parametrize('value', [[], (0.1, 0.2)])
def test_lists_become_tuples(value):
    assert Config.from_values(expected_length=value).plausibility.expected_length == tuple(value)
