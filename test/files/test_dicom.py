"""DICOM XA runs, made here, into bags: geometry, times and pixels derived by hand, and nothing that tells whose images
they are."""

import subprocess
import sys
import warnings
from pathlib import Path

import cv2
import numpy as np
import pytest

pytest.importorskip('rosbags')
pytest.importorskip('mcap')
pydicom = pytest.importorskip('pydicom', '3.0.1')

from drawing import SIZE, curve, draw
from pydicom.encaps import encapsulate
from pydicom.uid import JPEGBaseline8Bit, RLELossless
from scipy.spatial import cKDTree
from xa import PERSON, SID, SOD, logarithms, make

from fluoro_shape_ros.files import dicom, dicom_pixels, importer, replay
from fluoro_shape_ros.geometry.cameras import project, source
from msg_adapters.bags import open_bag
from msg_adapters.images import image_to_array
from msg_adapters.messages import stamp_ns
from msg_adapters.shapes import path_to_points

WIDE = 4 / 3                                # mm, pitch of the detector on which the device is drawn


def seen(angle):
    """(SIZE, SIZE) uint8: the drawn device at primary angle 0 or 90, as the files show it; projected by hand."""
    f, c, sod = SID / WIDE, (SIZE - 1) / 2, SOD / 1e3
    if angle == 0:      # the source is behind the patient: depth sod - y, u with x, v against z
        return draw(np.array([[f, -c, 0, c * sod], [0, -c, -f, c * sod], [0, -1, 0, sod]]))
    # it is at the patient's right: depth sod + x, u with y, v against z
    return draw(np.array([[c, f, 0, c * sod], [c, 0, -f, c * sod], [1, 0, 0, sod]]))


BLANK = np.full((2, 8, 9), 7, np.uint16)
PAIR = [np.stack([seen(angle)] * 2) for angle in (0, 90)]


@pytest.fixture
def files(tmp_path, monkeypatch):
    """a.dcm and b.dcm in the working directory."""
    monkeypatch.chdir(tmp_path)
    make('a.dcm', PAIR[0], ImageType=['ORIGINAL', 'PRIMARY', 'BIPLANE A'], ImagerPixelSpacing=[WIDE, WIDE])
    make('b.dcm', PAIR[1], 90.0, ImageType=['ORIGINAL', 'PRIMARY', 'BIPLANE B'], ImagerPixelSpacing=[WIDE, WIDE])
    return tmp_path


def read(path='out'):
    with open_bag(path) as bag:
        return {topic: [r.message for r in bag.messages([topic])] for topic in bag.types()}


def refused(capsys, *files):
    assert importer.main(['--dicom', *map(str, files), '--out', 'out']) == 1
    error = capsys.readouterr().err
    assert len(error.splitlines()) == 1 and 'ecret' not in error
    return error


# ---- geometry and time


def P_of(path):
    return dicom.read_run(path).calibrations[0].P


def test_projection_at_zero_and_from_the_left(tmp_path):
    """A point 10 mm off the isocentre is 10 * 1000 / 750 / 0.5 px off the middle; head is up, the patient's left at the
    right."""
    front, left = (P_of(make(tmp_path / 'run.dcm', BLANK, angle)) for angle in (0, 90))
    middle, step = np.array([4.0, 3.5]), 10 / 750 * 1000 / 0.5
    assert np.allclose(project(front, np.zeros(3)), middle) and np.allclose(project(left, np.zeros(3)), middle)
    assert np.allclose(project(front, np.array([0.01, 0, 0])) - middle, [step, 0])
    assert np.allclose(project(front, np.array([0, 0, 0.01])) - middle, [0, -step])
    # the spine is at the right of LAO views
    assert np.allclose(project(left, np.array([0, 0.01, 0])) - middle, [step, 0])
    assert np.allclose(source(front), [0, 0.75, 0]) and np.allclose(source(left), [-0.75, 0, 0])


def test_cranial_angles_put_the_source_below_and_pixels_need_not_be_square(tmp_path):
    P = P_of(make(tmp_path / 'run.dcm', BLANK, PositionerSecondaryAngle=30.0, ImagerPixelSpacing=[0.25, 0.5]))
    assert np.allclose(source(P), [0, 0.75 * np.cos(np.pi / 6), -0.375])
    assert project(P, np.array([0.0, 0, 0.01]))[1] < 3.5
    across = project(P, np.array([0.01, 0, 0])) - [4, 3.5]
    assert np.allclose(across, [10 / 750 * 1000 / 0.5, 0])
    K = dicom.read_run(tmp_path / 'run.dcm').calibrations[0].K
    assert K[1, 1] == 4000 and K[0, 0] == -2000      # rows come first in ImagerPixelSpacing


def test_the_patients_orientation_decides_against_the_usual_display(tmp_path):
    P = P_of(make(tmp_path / 'run.dcm', BLANK, PatientOrientation=['R', 'F']))
    assert project(P, np.array([0.01, 0, 0]))[0] < 4 and project(P, np.array([0, 0, 0.01]))[1] < 3.5
    assert np.allclose(P_of(make(tmp_path / 'run.dcm', BLANK, PatientOrientation=['L', 'F'])),
                       P_of(make(tmp_path / 'run.dcm', BLANK)))


def test_a_moving_run_has_a_camera_a_frame(tmp_path):
    moving = dicom.read_run(make(tmp_path / 'run.dcm', np.repeat(BLANK, 2, axis=0), 10.0,
                                 PositionerPrimaryAngleIncrement=[0, 5, 10, 10]))
    at = [P_of(make(tmp_path / 'still.dcm', BLANK, angle)) for angle in (10, 15, 20, 20)]
    assert all(np.allclose(c.P, P) for c, P in zip(moving.calibrations, at, strict=True))
    assert moving.calibrations[3] is moving.calibrations[2] is not moving.calibrations[1]


@pytest.mark.parametrize('attributes, milliseconds', [
    (dict(FrameTime=33.333), [0, 33.333]),
    (dict(FrameTime=None, FrameTimeVector=[0, 66.7]), [0, 66.7]),
    (dict(FrameTimeVector=[0, 66.7], FrameIncrementPointer=0x00181065), [0, 66.7]),
    (dict(FrameTimeVector=[0, 66.7], FrameIncrementPointer=0x00181063), [0, 100]),
    (dict(FrameTime=None, CineRate=8), [0, 125]),
    (dict(FrameTime=None, RecommendedDisplayFrameRate=20), [0, 50]),
    (dict(FrameTime=None), None),
])
def test_times_of_the_frames(tmp_path, attributes, milliseconds):
    times = dicom.read_run(make(tmp_path / 'run.dcm', BLANK, **attributes)).times_ns
    assert times is milliseconds is None or np.allclose(times, np.array(milliseconds) * 1e6)


# ---- pixels


@pytest.mark.parametrize('raw, attributes, value', [
    (0x0abc, dict(BitsStored=12, HighBit=11), 0xabc),
    (0xfabc, dict(BitsStored=12, HighBit=11), 0xabc),       # something else in the unused bits
    (0xabcf, dict(BitsStored=12, HighBit=15), 0xabc),
    (0xffff, {}, 0xffff),
    (0xfffe, dict(PixelRepresentation=1), 0x7ffe),          # -2, with -32768 raised to 0
    (0x0801, dict(BitsStored=12, HighBit=11, PixelRepresentation=1), 1),
    (0x0001, dict(BitsStored=12, HighBit=11, PhotometricInterpretation='MONOCHROME1'), 0xffe),
    (0x0123, dict(WindowCenter=5, WindowWidth=3), 0x123),   # is for displays
    (0x0123, dict(PixelIntensityRelationship='LOG'), 0x123),
])
def test_pixels_as_stored(tmp_path, raw, attributes, value):
    run = dicom.read_run(make(tmp_path / 'run.dcm', np.full((2, 3, 4), raw, np.uint16), **attributes))
    frames = list(dicom_pixels.pictures(run))
    assert len(frames) == 2 and all(f.dtype == np.uint16 and f.shape == (3, 4) and (f == value).all() for f in frames)


def test_logarithms_become_intensities_by_the_files_own_table(tmp_path):
    run = dicom.read_run(make(tmp_path / 'run.dcm', np.full((1, 3, 4), 200, np.uint8), **logarithms()))
    assert [frame.tolist() for frame in dicom_pixels.pictures(run)] == [[[40000] * 4] * 3]


def test_a_table_in_bytes(tmp_path):
    path = make(tmp_path / 'run.dcm', np.array([[[0, 3, 200, 255]]], np.uint8), **logarithms())
    header = pydicom.dcmread(path)
    header.ModalityLUTSequence[0]['LUTData'] = pydicom.DataElement(0x00283006, 'OW',
                                                                   (np.arange(256, dtype='<u2') ** 2).tobytes())
    header.save_as(path)
    assert [frame.tolist() for frame in dicom_pixels.pictures(dicom.read_run(path))] == [[[0, 9, 40000, 65025]]]


def test_a_table_for_signed_logarithms_begins_below_zero(tmp_path):
    table = logarithms(descriptor=[256, -128, 16])
    run = dicom.read_run(make(tmp_path / 'run.dcm', np.array([[[-128, -1, 0, 127]]], np.int8),
                              PixelRepresentation=1, **table))
    assert [frame.tolist() for frame in dicom_pixels.pictures(run)] == [[[0, 127**2, 128**2, 255**2]]]


@pytest.mark.parametrize('descriptor', [[256, 0, 65535], [0, 0, 16], [256, 0], [256, 0, 8], [1, 0, 16]])
def test_a_table_that_can_be_none_is_named(tmp_path, descriptor):
    run = dicom.read_run(make(tmp_path / 'run.dcm', np.full((1, 3, 4), 200, np.uint8), **logarithms(descriptor)))
    with pytest.raises(dicom.BadDicom, match='its Modality LUT'):
        next(dicom_pixels.pictures(run))


@pytest.mark.parametrize('keyword, vr, value', [
    ('ImageType', 'US', 7), ('PatientOrientation', 'FD', [1.0, 2.0]), ('FrameIncrementPointer', 'LO', 'FrameTime'),
    ('FrameIncrementPointer', 'AT', [0x00181063] * 2), ('ModalityLUTSequence', 'LO', 'abc'),
    ('PixelIntensityRelationship', 'US', 3), ('PhotometricInterpretation', 'CS', ['MONOCHROME1', 'RGB']),
    ('NumberOfFrames', 'FD', float('nan')), ('PositionerPrimaryAngle', 'FD', float('inf')), ('FrameTime', 'FD', 1e300),
    ('BitsStored', 'FD', 0.5),
    ('PhotometricInterpretation', 'LO', 'GREY\x1b[2J'), ('PixelRepresentation', 'LO', 'maybe'), ('HighBit', 'SS', -1),
    ('SamplesPerPixel', 'LO', 'one'), ('CineRate', 'FD', 1e-320)])
def test_attributes_of_another_kind_are_read_or_named(tmp_path, keyword, vr, value):
    """A file says of what kind its values are; `LOG` has a table looked for."""
    path = make(tmp_path / 'run.dcm', BLANK, PixelIntensityRelationship='LOG')
    header = pydicom.dcmread(path)
    with warnings.catch_warnings(action='ignore'):
        header[keyword] = pydicom.DataElement(pydicom.tag.Tag(keyword), vr, value)
        header.save_as(path)
    try:
        run = dicom.read_run(path)
        assert all(np.isfinite(c.P).all() for c in run.calibrations) and len(list(dicom_pixels.pictures(run))) == 2
    except dicom.BadDicom as error:
        assert str(error).isprintable()


@pytest.mark.parametrize('keyword', ['SOPClassUID', 'ImageType', 'Rows', 'PatientOrientation',
                                     'PixelIntensityRelationship'])
def test_a_sequence_for_a_value_is_named(files, capsys, keyword):
    header = pydicom.dcmread('a.dcm')
    header[keyword] = pydicom.DataElement(pydicom.tag.Tag(keyword), 'SQ', [pydicom.Dataset()])
    header.save_as('a.dcm')
    assert f'{keyword} is a sequence' in refused(capsys, 'a.dcm', 'b.dcm')


def test_compressed_frames(tmp_path):
    """RLE, which pydicom decodes by itself, and JPEG."""
    path = make(tmp_path / 'run.dcm', PAIR[0])
    header = pydicom.dcmread(path)
    header.compress(RLELossless)
    header.save_as(tmp_path / 'rle.dcm')
    assert all(np.array_equal(f, PAIR[0][0]) for f in dicom_pixels.pictures(dicom.read_run(tmp_path / 'rle.dcm')))
    jpeg = cv2.imencode('.jpg', PAIR[0][0], [cv2.IMWRITE_JPEG_QUALITY, 95])[1].tobytes()
    make(path, PAIR[0], syntax=JPEGBaseline8Bit, pixel_data=encapsulate([jpeg, jpeg]))
    try:
        frames = list(dicom_pixels.pictures(dicom.read_run(path)))
    except dicom.BadDicom as error:
        if 'needs one of' in str(error):
            pytest.skip('no plug-in for JPEG')
        raise
    assert len(frames) == 2 and np.abs(frames[1].astype(int) - PAIR[0][0]).max() < 20
    assert dicom_pixels.codestream_size(jpeg) == (SIZE, SIZE, 1)


# ---- through the command line


def test_imported_runs_replay_to_the_device(files, capsys):
    assert importer.main(['--dicom', 'b.dcm', 'a.dcm', '--out', 'out']) == 0      # the files say which is which
    assert '2 pairs in out' in capsys.readouterr().out
    bag = read()
    assert ([stamp_ns(m) for m in bag['/plane_a/image_raw']] == [10**9, 1_100_000_000]
            == [stamp_ns(m) for m in bag['/plane_b/camera_info']])
    assert np.array_equal(image_to_array(bag['/plane_a/image_raw'][0]), PAIR[0][0])
    base = 'base_position=[{:.4f},{:.4f},{:.4f}]'.format(*curve()[0])
    assert replay.main(['out', '--out', 'results', '-p', 'robot_radius=0.001', '-p', base, '-p',
                        'reference_frame=isocentre']) == 0
    paths = read('results')['/backbone']
    assert len(paths) == 2 and paths[0].header.frame_id == 'isocentre'
    assert cKDTree(curve()).query(path_to_points(paths[0]))[0].max() < 0.004


def test_a_moving_run_sends_camera_infos_anew(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    make('a.dcm', BLANK, PositionerPrimaryAngleIncrement=[0, 5])
    make('b.dcm', BLANK, 90.0)
    assert importer.main(['--dicom', 'a.dcm', 'b.dcm', '--out', 'out', '--rate', '5']) == 0
    first, second = read()['/plane_a/camera_info']
    assert not np.array_equal(first.p, second.p) and (stamp_ns(first), stamp_ns(second)) == (10**9, 1_200_000_000)


def test_nothing_tells_whose_images_they_are(files):
    done = subprocess.run([sys.executable, '-c', f'import sys\nsys.path[:0] = {[p for p in sys.path if p]!r}\nfrom '
                                                 'fluoro_shape_ros.files.importer import main\n' 'sys.exit(main())',
                           '--dicom', 'a.dcm', 'b.dcm', '--out', 'out'], capture_output=True, text=True, timeout=120)
    assert done.returncode == 0, done.stderr
    written = b''.join(p.read_bytes() for p in (files / 'out').iterdir()) + (done.stdout + done.stderr).encode()
    for word in map(str.encode, PERSON.values()):
        assert word in (files / 'a.dcm').read_bytes() and word not in written, word


@pytest.mark.parametrize('attributes, says', [
    (dict(Rows=8000, Columns=8000, NumberOfFrames=1000),
     'truncated: 1000 frames of 8000x8000 px need 128000000000 bytes, the file has'),
    (dict(Rows=60000), 'Rows must be one number in [1, 8192]'),
    (dict(DistanceSourceToDetector=None), 'DistanceSourceToDetector is missing'),
    (dict(DistanceSourceToPatient=1200.0), 'is not in front of the detector'),
    (dict(ImagerPixelSpacing=None), 'ImagerPixelSpacing must be two distances'),
    (dict(PositionerPrimaryAngle=None), 'PositionerPrimaryAngle is missing'),
    (dict(PositionerPrimaryAngleIncrement=[0, 1, 2]), 'PositionerPrimaryAngleIncrement has 3 values for 2 frames'),
    (dict(FrameTimeVector=[0, -1]), 'FrameTimeVector'),
    (dict(PhotometricInterpretation='RGB', SamplesPerPixel=3), 'only grey pixels of 8 or 16 bits are read, not RGB'),
    (dict(syntax=pydicom.uid.MPEG2MPML, pixel_data=encapsulate([b'12345678'] * 2)), 'compressed as MPEG2'),
    (dict(syntax=RLELossless, pixel_data=encapsulate([b'12345678'] * 2)), 'frame 1 can\'t be decoded'),
    (dict(ImageType=['ORIGINAL', 'PRIMARY', 'BIPLANE B']), 'both are of plane B'),
])
def test_what_can_not_work_is_said_in_one_line(files, capsys, attributes, says):
    make('a.dcm', BLANK, **attributes)
    assert says in refused(capsys, 'a.dcm', 'b.dcm')
    assert not (files / 'out').exists()


def test_files_that_are_none(files, capsys):
    whole = (files / 'a.dcm').read_bytes()
    (files / 'text.dcm').write_text('not DICOM')
    (files / 'cut.dcm').write_bytes(whole[:-1000])
    (files / 'head.dcm').write_bytes(whole[:400])
    assert 'text.dcm: not a DICOM file' in refused(capsys, 'text.dcm', 'b.dcm')
    assert 'cut.dcm: truncated: 2 frames of 320x320 px need' in refused(capsys, 'cut.dcm', 'b.dcm')
    assert 'head.dcm: ' in refused(capsys, 'head.dcm', 'b.dcm')
    assert 'none.dcm' in refused(capsys, 'none.dcm', 'b.dcm')
    assert 'coincide' in refused(capsys, 'a.dcm', make('again.dcm', PAIR[0], ImagerPixelSpacing=[WIDE, WIDE]))


def padded(jpeg):
    """With filled up markers, which is allowed."""
    return jpeg.replace(b'\xff\xc0', b'\xff\xff\xff\xc0', 1)


def larger(jpeg):
    at = jpeg.index(b'\xff\xc0') + 5
    return jpeg[:at] + b'\xff\xf0\xff\xf0' + jpeg[at + 4:]


def test_a_sequence_that_ends_too_soon_is_named(files, capsys):
    """pydicom raises an OSError that does not name the file; fuzz.py found it."""
    (files / 'short.dcm').write_bytes(bytes(128) + b'DICM\2\0\0\0SQ\4\0\xd2\0\0\0\0')
    assert 'short.dcm: damaged: ' in refused(capsys, 'short.dcm', 'b.dcm')


@pytest.mark.parametrize('change, says', [
    (larger, 'frame 1 is 65520x65520 px inside, but 320x320 by the header'),
    (lambda jpeg: padded(larger(jpeg)), 'frame 1 is 65520x65520 px inside'),
    (lambda jpeg: cv2.imencode('.jpg', np.dstack([PAIR[0][0]] * 3))[1].tobytes(), '320x320 px of 3 colours'),
    (lambda jpeg: b'\0' * len(jpeg), 'it does not say how large it is'),
])
def test_a_compressed_frame_larger_than_it_says_is_refused_unopened(files, capsys, change, says):
    jpeg = change(cv2.imencode('.jpg', PAIR[0][0])[1].tobytes())
    make('a.dcm', PAIR[0], syntax=JPEGBaseline8Bit, pixel_data=encapsulate([jpeg] * 2))
    said = refused(capsys, 'a.dcm', 'b.dcm')
    assert says in said or 'needs one of' in said


def test_a_decoder_that_ends_its_process_is_named(files, capsys):
    """A damaged JPEG, found by fuzz.py, on which GDCM 3.2.6 calls std::terminate."""
    (files / 'a.dcm').write_bytes((Path(__file__).parents[1] / 'gdcm_abort.dcm').read_bytes())
    assert 'can\'t be decoded' in refused(capsys, 'a.dcm', 'b.dcm')


def test_filled_up_markers_are_skipped():
    jpeg = cv2.imencode('.jpg', PAIR[0][0])[1].tobytes()
    assert dicom_pixels.codestream_size(padded(jpeg)) == dicom_pixels.codestream_size(jpeg) == (SIZE, SIZE, 1)


def test_more_than_a_file_can_hold_is_refused(files, capsys):
    make('a.dcm', PAIR[0], syntax=JPEGBaseline8Bit, pixel_data=encapsulate([b'12345678'] * 2), Rows=8192, Columns=8192)
    assert ('2 frames of 8192x8192 px are more than 1000 times as large as the file'
            in (said := refused(capsys, 'a.dcm', 'b.dcm')) or 'needs one of' in said)


def test_garbage_never_ends_in_another_error(tmp_path):
    data, rng, named = make(tmp_path / 'run.dcm', BLANK).read_bytes(), np.random.default_rng(3), 0
    for _ in range(80):
        broken = bytearray(data)
        start = rng.integers(132, len(data) - 8)
        broken[start:start + 8] = rng.bytes(8)
        (tmp_path / 'run.dcm').write_bytes(broken)
        try:
            list(dicom_pixels.pictures(dicom.read_run(tmp_path / 'run.dcm')))
        except dicom.BadDicom as error:
            named += 1
            assert 'ecret' not in str(error) and '\n' not in str(error)
    assert named


def test_without_pydicom_it_names_the_extra(files, monkeypatch, capsys):
    for module in [name for name in sys.modules if name.split('.')[0] == 'pydicom']:
        monkeypatch.delitem(sys.modules, module)
    monkeypatch.setitem(sys.modules, 'pydicom', None)
    assert 'needs pydicom' in (said := refused(capsys, 'a.dcm', 'b.dcm')) and 'fluoro_shape_ros[dicom]' in said


@pytest.mark.parametrize('given', [['--dicom', 'a', 'b', '--plane-a', 'c'], ['--dicom', 'a'], ['--plane-a', 'a']])
def test_either_files_or_dicom(given, capsys):
    with pytest.raises(SystemExit) as end:
        importer.main([*given, '--out', 'out'])
    assert end.value.code == 2 and 'dicom' in capsys.readouterr().err
