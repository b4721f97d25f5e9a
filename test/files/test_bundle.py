"""What a report of a fault is packed into: the same answers again, and nothing of a patient."""

import contextlib
import getpass
import io
import json
import platform
import shlex
import zipfile
import zlib
from pathlib import Path

import cv2
import numpy as np
import pytest

pytest.importorskip('rosbags')
pytest.importorskip('mcap')
pytest.importorskip('plotly')

from drawing import BASE, BLANK, CALIBRATIONS, GOOD
from recording import IMAGE, INFO, SECOND, main, outcomes, read, record
from scipy.spatial.transform import Rotation

from fluoro_shape_ros.config import Config
from fluoro_shape_ros.device import load_device, presets
from fluoro_shape_ros.files import bundle, replay
from fluoro_shape_ros.files.cut_bag import BEGIN_NS, renamed
from fluoro_shape_ros.files.parameter_files import read_parameters
from fluoro_shape_ros.geometry.cameras import decompose
from msg_adapters.bags import create_bag, open_bag
from msg_adapters.calibration import Calibration, calibration_to_camera_info
from msg_adapters.images import array_to_image
from msg_adapters.messages import header, stamp_ns

BEGIN = 1_717_243_200 * SECOND      # a date of the recording
STEP = SECOND // 10
PAIRS = [BLANK, BLANK, GOOD, GOOD, GOOD, BLANK, GOOD, GOOD, GOOD]
SECRETS = [b'DOE', b'JOHN', b'1961', b'ward', b'case', b'ECG', b'jane']     # of what is recorded below
TOPICS = [word for p, name in (('a', 'frontal'), ('b', 'lateral'))
          for word in (f'--image-{p}', f'/ward/{name}/image_raw', f'--info-{p}', f'/ward/{name}/camera_info')]
CLINICAL = [*TOPICS, '-p', 'geometry=tf', '-p', 'reference_frame=JOHN DOE', '-p', BASE, '-p', 'tracking=false',
            '--mask', 1.15]     # the bag begins 1 s before the images


def with_words(png):
    """A PNG with a text chunk behind its head."""
    chunk = b'tEXtPatient\0DOE^JOHN'
    return np.frombuffer(b''.join((png[:33], (len(chunk) - 4).to_bytes(4, 'big'), chunk,
                                   zlib.crc32(chunk).to_bytes(4, 'big'), png[33:])), np.uint8)


def transform(new, parent, child, stamp, R, t):
    x, y, z, w = Rotation.from_matrix(R).as_quat().tolist()
    moved = new('geometry_msgs/msg/Transform', translation=new('geometry_msgs/msg/Vector3',
                                                               **dict(zip('xyz', map(float, t)))),
                rotation=new('geometry_msgs/msg/Quaternion', x=x, y=y, z=z, w=w))
    return new('tf2_msgs/msg/TFMessage',
               transforms=[new('geometry_msgs/msg/TransformStamped', header=header(new, stamp, parent),
                               child_frame_id=child, transform=moved)])


def clinical(path, compressed):
    """Two pairs for the mask and seven others, full of names; poses come from tf twice a second, camera infos once,
    before the images."""
    suffix, kind = ('/compressed', 'sensor_msgs/msg/CompressedImage') if compressed else ('', IMAGE)
    with create_bag(path) as bag:
        new = bag.new
        for topic, what in (('/tf', 'tf2_msgs/msg/TFMessage'), ('/patient', 'std_msgs/msg/String'),
                            ('/ward/predicted_backbone', 'nav_msgs/msg/Path'),
                            *((f'/ward/{name}/{topic}', what) for name in ('frontal', 'lateral')
                              for topic, what in ((f'image_raw{suffix}', kind), ('camera_info', INFO)))):
            bag.declare(topic, what)
        bag.write('/patient', new('std_msgs/msg/String', data='DOE^JOHN, 1961, case 4711'), BEGIN - SECOND)
        for name, c in zip(('frontal', 'lateral'), CALIBRATIONS):
            _, R, t = decompose(c.P)
            for k in range(5):
                stamp = BEGIN + (k - 1) * 5 * STEP
                bag.write('/tf', transform(new, 'JOHN DOE', f'DOE^{name}', stamp, R.T, -R.T @ t), stamp)
                bag.write('/tf', transform(new, 'JOHN DOE', 'jane', stamp, R.T, t), stamp)
            intrinsics = Calibration(c.camera_name, c.width, c.height, c.K, np.c_[c.K, np.zeros(3)], 'plumb_bob',
                                     np.zeros(5))
            bag.write(f'/ward/{name}/camera_info',
                      calibration_to_camera_info(intrinsics, BEGIN - STEP, f'DOE^{name}', new), BEGIN - STEP)
        for k, pair in enumerate(PAIRS):
            stamp = BEGIN + k * STEP
            bag.write('/ward/predicted_backbone', new('nav_msgs/msg/Path', header=header(new, stamp, 'JOHN DOE')),
                      stamp)
            for name, pixels in zip(('frontal', 'lateral'), pair):
                message = array_to_image(pixels, stamp, f'DOE^{name}', new)
                if compressed:
                    message = new(kind, header=message.header, format='png; ECG of DOE',
                                  data=with_words(cv2.imencode('.png', pixels)[1].tobytes()))
                bag.write(f'/ward/{name}/image_raw{suffix}', message, stamp + 1)
    return path


def unpacked(path, folder):
    with zipfile.ZipFile(path) as packed:
        packed.extractall(folder)
    return folder / bundle.FOLDER


@pytest.fixture(scope='module', params=['raw', 'compressed'])
def packed(request, tmp_path_factory):
    """A folder with a clinical bag, its results in `out`, and the bundle as it was unpacked in `there`; what was
    printed."""
    folder = tmp_path_factory.mktemp('jane')
    clinical(folder / 'run', request.param == 'compressed')
    (folder / 'case.yaml').write_text('# of JOHN DOE\nsegments: [{length: rest, radius: 0.001, material: metal}]\n')
    given = [*CLINICAL, '-p', f'image_transport={request.param}', '-p', f'device={folder / "case.yaml"}', '--bundle',
             folder / 'fault.zip', '--bundle-seconds', 0.4]
    with contextlib.redirect_stdout(io.StringIO()) as said:
        assert main(folder / 'run', '--out', folder / 'out', *given) == 0
    return folder, unpacked(folder / 'fault.zip', folder / 'there'), said.getvalue()


def test_the_bag_in_it_gives_the_same_answers_again(packed, tmp_path, monkeypatch):
    """By the command that README.txt in it names."""
    folder, there, _ = packed
    command = next(line for line in (there / 'README.txt').read_text().splitlines()
                   if line.startswith('    fluoro_shape_replay '))
    monkeypatch.chdir(there)
    assert replay.main([word if word not in ('results', 'page.html') else str(tmp_path / word)
                        for word in shlex.split(command)[1:]]) == 0
    told = json.loads((there / 'outcomes.json').read_text())
    assert outcomes(tmp_path / 'results') == {round(pair['stamp_s'] * 1e9): pair['bag'] for pair in told['pairs']}
    assert ([pair['bag'] for pair in told['pairs']] == [pair['recording'] for pair in told['pairs']]
            == ['ok', 'ok', 'no_device_in_plane_a', 'ok'])
    assert told['otherwise_in_bag'] == 0 and told['recording'] == {'pairs': 7,
                                                                   'outcomes': {'ok': 6, 'no_device_in_plane_a': 1}}
    before, again = ([(m.point.x, m.point.y, m.point.z) for _, m in read(path)['/tip']]
                     for path in (folder / 'out', tmp_path / 'results'))
    assert again == [before[1], before[2], before[3]] == [tuple(pair['tip_m'])
                                                          for pair in told['pairs'] if pair['tip_m']]


def test_it_has_the_parameters_and_versions(packed):
    _, there, said = packed
    assert {path.name for path in there.iterdir()} == {'README.txt', 'bag', 'device.yaml', 'outcomes.json',
                                                       'params.yaml', 'report.html', 'versions.json'}
    used = read_parameters(str(there / 'params.yaml'))
    assert (used['robot_radius'] == 0.001 and used['geometry'] == 'tf' and used['tracking'] is False
            and used['device'] == 'device.yaml')
    assert used.keys() >= Config().values().keys() - {'expected_length'}    # in ROS an empty list says nothing
    versions = json.loads((there / 'versions.json').read_text())
    assert (versions['numpy'] == np.__version__ and versions['opencv'] == cv2.__version__
            and versions['python'] == platform.python_version())
    line = next(line for line in said.splitlines() if line.startswith('packed '))
    assert ('packed 0.4 s around the first refused pair (no_device_in_plane_a)' in line and '4 pairs' in line
            and 'LOOK at' in line)


def test_nothing_of_a_patient_is_in_it(packed):
    """No name, no date, no other topic; of the images the pixels alone."""
    folder, there, _ = packed
    texts = {path.name: path.read_bytes() for path in there.rglob('*') if path.is_file()}
    own = [word.encode() for word in (getpass.getuser(), platform.node(), str(Path.home()), str(folder))
           if len(word) > 4]
    assert b'renamed_frame_1' in texts['bag.mcap']      # nothing is compressed, so that a word would be seen
    # the rest is ours and plotly's
    page = texts.pop('report.html').split(b'<script id="data"')[1].split(b'</script>')[0]
    for name, text in (*texts.items(), ('report.html', page)):
        assert [word for word in (*SECRETS, *own) if word in text] == [], name
    found = read(there / 'bag')
    kind = next(topic for topic in found if topic.startswith('/plane_a/image_raw'))
    assert set(found) == {kind, kind.replace('plane_a', 'plane_b'), '/plane_a/camera_info', '/plane_b/camera_info',
                          '/tf', '/tf_static', '/predicted_backbone'}
    with open_bag(there / 'bag') as bag:
        assert bag.start_ns == BEGIN_NS and bag.end_ns < BEGIN_NS + SECOND
    stamps = [stamp_ns(m) for topic in (kind, '/plane_b/camera_info', '/predicted_backbone') for _, m in found[topic]]
    assert max(stamps) < BEGIN_NS + SECOND and stamps[0] == BEGIN_NS and len(found[kind]) == 2 + 4
    children = {t.child_frame_id for _, m in found['/tf'] for t in m.transforms}
    assert len(children) == 2 and all(child.startswith('renamed_frame_') for child in children)
    if 'compressed' in kind:
        assert [np.array_equal(cv2.imdecode(m.data, cv2.IMREAD_UNCHANGED), pair[0])
                for (_, m), pair in zip(found[kind][2:], PAIRS[3:])] == [True] * 4


def test_without_a_refused_pair_it_is_around_the_worst(tmp_path, capsys):
    """Tracked from one pair to the next; a bag that is shorter than what is asked for is all there."""
    record(tmp_path / 'run', [GOOD] * 3)
    assert main(tmp_path / 'run', '--out', tmp_path / 'out', '-p', BASE, '--bundle', tmp_path / 'fault.zip') == 0
    assert 'around the worst pair (ok)' in capsys.readouterr().out
    told = json.loads((unpacked(tmp_path / 'fault.zip', tmp_path) / 'outcomes.json').read_text())
    assert [pair['bag'] for pair in told['pairs']] == ['ok'] * 3 and told['reported']['what'] == 'the worst pair'
    assert [log for log, _ in read(tmp_path / bundle.FOLDER / 'bag')['/plane_a/image_raw']] == [BEGIN_NS + k * STEP
                                                                                                for k in range(3)]


def test_what_can_not_be_packed_is_said(tmp_path, capsys):
    record(tmp_path / 'run', [GOOD])
    (tmp_path / 'fault.zip').touch()
    assert main(tmp_path / 'run', '--out', tmp_path / 'out', '--bundle', tmp_path / 'fault.zip') == 1
    assert ('fault.zip exists already and is not overwritten' in capsys.readouterr().err
            and not (tmp_path / 'out').exists())
    with pytest.raises(SystemExit, match='2'):
        main(tmp_path / 'run', tmp_path / 'run', '--out', tmp_path / 'out', '--bundle', tmp_path / 'other.zip')


@pytest.mark.parametrize('frame_id', ['plane_a_optical', 'isocenter', 'robot1/base_link', '/arm', ''])
def test_names_of_frames_stay(frame_id):
    assert renamed()(frame_id) == frame_id


@pytest.mark.parametrize('frame_id', ['DOE^JOHN', 'John Doe', 'doe, john', 'P19610412', 'scan_2024',
                                      '/home/jane/case.yaml', 'a@b', 'Müller', 'x' * 41, platform.node() or 'a b'])
def test_others_are_called_otherwise(frame_id):
    names = renamed()
    first, second = names(frame_id), names('another one')
    assert (first, second, names(frame_id)) == ('renamed_frame_1', 'renamed_frame_2', first)


def test_the_seconds_lie_within_what_there_is():
    assert bundle.span_around(50 * SECOND, 3, 0, 100 * SECOND) == (48_500_000_000, 51_500_000_000)
    assert bundle.span_around(SECOND, 3, 0, 100 * SECOND) == (0, 3 * SECOND)
    assert bundle.span_around(99 * SECOND, 3, 0, 100 * SECOND) == (97 * SECOND, 100 * SECOND)
    assert bundle.span_around(SECOND, 3, 0, 2 * SECOND) == (0, 2 * SECOND)


def test_a_device_reads_back(tmp_path):
    for name in presets():
        (tmp_path / 'device.yaml').write_text(bundle.device_text(load_device(name)))
        assert load_device(tmp_path / 'device.yaml') == load_device(name)
