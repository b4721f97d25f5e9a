"""The layouts for RViz and Foxglove: they parse, and show our topics by displays that take their types."""

import json
import re

import pytest

from fluoro_shape_ros.resources import resource_path

TOPICS = {'/backbone': 'Path', '/tip': 'PointStamped', '/tip_pose': 'PoseWithCovarianceStamped',
          '/backbone_points': 'PointCloud2', '/markers': 'MarkerArray',
          '/plane_a/overlay': 'Image', '/plane_b/overlay': 'Image', '/diagnostics': 'DiagnosticArray'}
# displays of rviz_default_plugins in Jazzy (its plugins_description.xml) and what they show;
# None: nothing from a topic of ours
RVIZ_DISPLAYS = {'Axes': None, 'Grid': None, 'TF': None, 'Image': 'Image', 'MarkerArray': 'MarkerArray', 'Path': 'Path',
                 'PointCloud2': 'PointCloud2',
                 'PointStamped': 'PointStamped', 'PoseWithCovariance': 'PoseWithCovarianceStamped'}
FOXGLOVE_PANELS = {'3D', 'Image', 'Plot', 'DiagnosticSummary', 'DiagnosticStatusPanel'}


def test_rviz_shows_backbone_tip_markers_and_both_overlays():
    yaml = pytest.importorskip('yaml')
    manager = yaml.safe_load(resource_path('fluoro_shape.rviz').read_text())['Visualization Manager']
    shown = {}
    for display in manager['Displays']:
        package, kind = display['Class'].split('/')
        assert (package == 'rviz_default_plugins' and kind in RVIZ_DISPLAYS
                and display['Enabled'] == display['Value']), display['Name']
        if RVIZ_DISPLAYS[kind] is not None:
            topic = display['Topic']['Value']
            assert TOPICS[topic] == RVIZ_DISPLAYS[kind], topic
            shown[topic] = display['Enabled']
    assert set(shown) == set(TOPICS) - {'/diagnostics'}
    assert all(shown[topic] for topic in ('/backbone', '/tip', '/markers', '/plane_a/overlay', '/plane_b/overlay'))
    assert len({display['Name'] for display in manager['Displays']}) == len(manager['Displays'])
    assert manager['Global Options']['Fixed Frame'] == 'isocenter'


def leaves(layout):
    return [layout] if isinstance(layout, str) else leaves(layout['first']) + leaves(layout['second'])


def test_foxglove_shows_backbone_tip_markers_both_overlays_and_diagnostics():
    layout = json.loads(resource_path('foxglove_layout.json').read_text())
    panels = layout['configById']
    assert sorted(leaves(layout['layout'])) == sorted(panels)
    assert {name.split('!')[0] for name in panels} == FOXGLOVE_PANELS
    named = set(re.findall(r'"(/[a-z_/]+)', json.dumps(panels)))
    assert named == {*TOPICS, '/fluoro_shape'}     # the node's name stands before those of its statuses
    assert [panels[f'Image!plane_{p}']['imageMode']['imageTopic'] for p in 'ab'] == ['/plane_a/overlay',
                                                                                     '/plane_b/overlay']
    assert all(panels['3D!backbone']['topics'][topic]['visible'] for topic in ('/markers', '/backbone', '/tip_pose'))
