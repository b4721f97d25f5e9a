"""What DICOM files leave out, say twice or say otherwise: each kind made here, with cameras, times and pixels worked
out by hand."""

from pathlib import Path

import cv2
import numpy as np
import pytest

pytest.importorskip('rosbags')
pytest.importorskip('mcap')
pydicom = pytest.importorskip('pydicom', '3.0.1')

from drawing import BASE, GOOD, SIZE, VIEWS, K, curve
from pydicom.encaps import encapsulate
from pydicom.uid import ExplicitVRBigEndian, ImplicitVRLittleEndian, JPEGBaseline8Bit, RLELossless
from scipy.spatial import cKDTree
from xa import PERSON, PITCH, SID, SOD, enhanced, make

from fluoro_shape_ros.files import dicom, dicom_pixels, importer, replay
from fluoro_shape_ros.files.dicom_header import BadDicom
from msg_adapters.bags import open_bag
from msg_adapters.calibration import Calibration, write_calibration
from msg_adapters.images import image_to_array
from msg_adapters.messages import stamp_ns
from msg_adapters.shapes import path_to_points

FRAMES = np.stack([np.full((8, 10), value, np.uint16) for value in (7, 8, 9)])
BYTES = FRAMES.astype(np.uint8)


@pytest.fixture(autouse=True)
def here(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)


def focal(**attributes):
    """Focal lengths along columns and rows in px, and what is said of them."""
    given = dict(ImagerPixelSpacing=None) | attributes
    run = dicom.read_run(make('run.dcm', FRAMES, **given), given.pop('spacing_mm', None))
    return run.calibrations[0].K[1, 1], -run.calibrations[0].K[0, 0], run.notes


def values(path):
    """The first pixel of each frame."""
    return [int(frame[0, 0]) for frame in dicom_pixels.pictures(dicom.read_run(path))]


def imported(capsys, *arguments, code=0):
    assert importer.main([*arguments, '--out', 'out']) == code
    said = capsys.readouterr()
    if code:
        assert len(said.err.splitlines()) == 1
        return said.err
    return said.out


def read(path='out'):
    with open_bag(path) as bag:
        return {topic: [r.message for r in bag.messages([topic])] for topic in bag.types()}


# ---- the size of a pixel


@pytest.mark.parametrize('attributes, spacing, says', [
    (dict(FieldOfViewDimensions=[4, 5]), 0.5, '0.5 mm is what the field of view of 4 x 5 mm gives'),
    (dict(FieldOfViewDimensions=[5, 4]), 0.5, '0.5 mm'),        # whichever of them is the height: pixels are square
    (dict(PixelSpacing=[0.3, 0.3], EstimatedRadiographicMagnificationFactor=1.5), 0.45,
     'PixelSpacing magnified 1.5 times'),
    (dict(PixelSpacing=[0.3, 0.3]), 0.3 * SID / SOD, 'PixelSpacing magnified 1.33 times'),      # to the isocentre
])
def test_what_a_pixel_measures_where_that_is_not_said_outright(attributes, spacing, says):
    rows, columns, notes = focal(**attributes)
    assert rows == columns == pytest.approx(SID / spacing)
    assert len(notes) == 1 and says in notes[0] and 'run.dcm' in notes[0]


def test_a_round_field_of_a_square_image():
    run = dicom.read_run(make('run.dcm', np.zeros((2, 8, 8), np.uint8), ImagerPixelSpacing=None,
                              FieldOfViewShape='ROUND', FieldOfViewDimensions=[16]))
    assert run.calibrations[0].K[1, 1] == pytest.approx(SID / 2)


@pytest.mark.parametrize('attributes', [{}, dict(FieldOfViewDimensions=[16]), dict(FieldOfViewDimensions=[4, 9]),
                                        dict(FieldOfViewDimensions=[4, 5, 6])])
def test_a_field_whose_pixels_would_not_be_square_tells_nothing(attributes):
    with pytest.raises(BadDicom, match='ImagerPixelSpacing must be two .* --pixel-spacing'):
        focal(**attributes)


def test_the_magnification_tells_where_the_isocentre_is():
    run = dicom.read_run(make('run.dcm', FRAMES, DistanceSourceToPatient=None,
                              EstimatedRadiographicMagnificationFactor=1.25))
    assert np.allclose(run.calibrations[0].P[2], [0, -1, 0, SID / 1.25 / 1e3])      # the last row of P is the depth


def test_pixel_spacing_from_the_command_line(capsys):
    make('a.dcm', FRAMES, ImagerPixelSpacing=None)
    make('b.dcm', FRAMES, 90.0, ImagerPixelSpacing=None)
    assert '--pixel-spacing' in imported(capsys, '--dicom', 'a.dcm', 'b.dcm', code=1)
    imported(capsys, '--dicom', 'a.dcm', 'b.dcm', '--pixel-spacing', '0.5', '0.25')
    bag = read()
    assert [bag[f'/plane_{p}/camera_info'][0].k[4] for p in 'ab'] == [SID / 0.5, SID / 0.25]
    for wrong in (['0'], ['0.5', '0.5', '0.5'], ['fine']):
        with pytest.raises(SystemExit, match='2'):
            importer.main(['--dicom', 'a.dcm', 'b.dcm', '--out', 'new', '--pixel-spacing', *wrong])


# ---- cameras of one's own


def test_own_calibrations_with_the_pixels_of_dicom(capsys):
    """Of the files nothing but pixels, times and the letter of the plane is needed."""
    bare = dict(ImagerPixelSpacing=None, DistanceSourceToDetector=None, DistanceSourceToPatient=None,
                PositionerPrimaryAngle=None)
    for p, other, pixels, P in zip('ab', 'ba', GOOD, VIEWS):        # a.dcm is of plane B
        make(f'{other}.dcm', np.stack([pixels] * 2), ImageType=['ORIGINAL', 'PRIMARY', f'BIPLANE {p.upper()}'], **bare)
        write_calibration(f'{p}.yaml', Calibration(f'plane_{p}', SIZE, SIZE, K, P, 'plumb_bob', np.zeros(5)))
    given = ['--dicom', 'a.dcm', 'b.dcm', '--camera-a', 'a.yaml', '--camera-b', 'b.yaml']
    imported(capsys, *given)
    assert np.array_equal(read()['/plane_b/camera_info'][0].p.reshape(3, 4), VIEWS[1])
    assert replay.main(['out', '--out', 'results', '-p', 'robot_radius=0.001', '-p', BASE]) == 0
    assert cKDTree(curve()).query(path_to_points(read('results')['/backbone'][0]))[0].max() < 0.0025
    with pytest.raises(SystemExit, match='2'):
        importer.main(given[:-2] + ['--out', 'new'])
    assert 'both, or none' in capsys.readouterr().err


# ---- pixels


@pytest.mark.parametrize('kind, shape, turned', [('MONOCHROME2', 'IDENTITY', False), ('MONOCHROME2', 'INVERSE', True),
                                                 ('MONOCHROME1', 'INVERSE', True),
                                                 ('MONOCHROME1', None, True), ('MONOCHROME1', 'IDENTITY', True)])
def test_white_for_black_by_either_name_is_turned_over_once(kind, shape, turned):
    assert (values(make('run.dcm', BYTES, PhotometricInterpretation=kind, PresentationLUTShape=shape))
            == ([248, 247, 246] if turned else [7, 8, 9]))


def jpegs(count=3):
    return [cv2.imencode('.jpg', BYTES[k])[1].tobytes() for k in range(count)]


@pytest.mark.parametrize('table', [False, True])
def test_an_empty_last_fragment_is_no_frame(table):
    whole = encapsulate(jpegs(), has_bot=table)
    assert (values(make('run.dcm', BYTES, syntax=JPEGBaseline8Bit, pixel_data=whole + b'\xfe\xff\x00\xe0' + bytes(4)))
            == [7, 8, 9])
    header = pydicom.dcmread(make('run.dcm', BYTES))
    header.compress(RLELossless)
    header.PixelData += b'\xfe\xff\x00\xe0' + bytes(4)
    header.save_as('rle.dcm')
    assert values('rle.dcm') == [7, 8, 9]


def test_frames_in_several_fragments():
    assert values(make('run.dcm', BYTES, syntax=JPEGBaseline8Bit,
                       pixel_data=encapsulate(jpegs(), fragments_per_frame=3, has_bot=False))) == [7, 8, 9]


def test_a_compressed_run_that_is_cut_off_is_refused():
    whole = make('run.dcm', BYTES, syntax=JPEGBaseline8Bit, pixel_data=encapsulate(jpegs()))
    Path('cut.dcm').write_bytes(Path(whole).read_bytes()[:-60])
    with pytest.raises(BadDicom, match='cut.dcm: (truncated|frame 3 can\'t be decoded)'):
        values('cut.dcm')


@pytest.mark.parametrize('count, says', [(2, 'NumberOfFrames is 2, but 3 are there: the last 1 is left out'),
                                         (None, 'NumberOfFrames is 1, but 3 are there: the last 2 are left out')])
@pytest.mark.parametrize('compressed', [False, True])
def test_more_frames_than_are_announced_are_said(capsys, count, says, compressed):
    more = dict(syntax=JPEGBaseline8Bit, pixel_data=encapsulate(jpegs())) if compressed else {}
    make('a.dcm', BYTES, NumberOfFrames=count, **more)
    make('b.dcm', BYTES, 90.0, NumberOfFrames=count)
    out = imported(capsys, '--dicom', 'a.dcm', 'b.dcm')
    assert f'a.dcm: {says}' in out.splitlines() and f'b.dcm: {says}' in out
    assert [image_to_array(m)[0, 0] for m in read()['/plane_a/image_raw']] == [7, 8][:count or 1]


def test_fewer_frames_than_are_announced_are_refused_in_one_line(capsys):
    make('a.dcm', BYTES, NumberOfFrames=5, syntax=JPEGBaseline8Bit, pixel_data=encapsulate(jpegs()))
    make('b.dcm', BYTES, 90.0)
    assert 'a.dcm: truncated: NumberOfFrames is 5, of which 3 are there' in imported(capsys, '--dicom', 'a.dcm',
                                                                                     'b.dcm', code=1)


@pytest.mark.parametrize('syntax', [None, ImplicitVRLittleEndian])
def test_files_without_preamble(syntax):
    """As written before Part 10, from the meta information or from the data set on."""
    make('whole.dcm', FRAMES, **({'syntax': syntax} if syntax else {}))
    data = Path('whole.dcm').read_bytes()
    Path('run.dcm').write_bytes(data[132:])
    assert values('run.dcm') == [7, 8, 9]
    bare = pydicom.dcmread('whole.dcm')
    length = bare.file_meta.FileMetaInformationGroupLength
    Path('run.dcm').write_bytes(data[144 + length:])
    assert values('run.dcm') == [7, 8, 9] and np.allclose(dicom.read_run('run.dcm').calibrations[0].P,
                                                          dicom.read_run('whole.dcm').calibrations[0].P)


def test_a_transfer_syntax_that_is_written_as_a_text():
    """fuzz.py found it."""
    whole = Path(make('run.dcm', FRAMES)).read_bytes()
    Path('run.dcm').write_bytes(whole.replace(b'\x02\0\x10\0UI', b'\x02\0\x10\0LO'))
    assert values('run.dcm') == [7, 8, 9]


def test_big_endian():
    assert values(make('big.dcm', FRAMES.astype('>u2'), syntax=ExplicitVRBigEndian)) == [7, 8, 9]


# ---- times


def test_a_rate_wins_over_a_vector_that_is_too_short(capsys):
    make('a.dcm', FRAMES, FrameTime=None, FrameTimeVector=[0, 50])
    make('b.dcm', FRAMES, 90.0)
    assert 'FrameTimeVector has 2 steps for 3 frames' in imported(capsys, '--dicom', 'a.dcm', 'b.dcm', code=1)
    imported(capsys, '--dicom', 'a.dcm', 'b.dcm', '--rate', '20')
    assert [stamp_ns(m) for m in read()['/plane_a/image_raw']] == [10**9, 1_050_000_000, 1_100_000_000]


def test_runs_of_other_rates_pair_by_their_times_and_it_is_said(capsys):
    """30/s and 15/s: every other image of plane A has no partner."""
    make('a.dcm', np.repeat(BYTES, 2, axis=0), FrameTime=1000 / 30)
    make('b.dcm', BYTES, 90.0, FrameTime=1000 / 15)
    out = imported(capsys, '--dicom', 'a.dcm', 'b.dcm')
    assert out.startswith('3 pairs in out\n')
    assert (out.splitlines()[-1] == 'plane A has 6 images at 30/s and plane B has 3 images at 15/s: '
                                    '3 have no partner within 10 ms')


def test_a_guessed_rate_is_said(capsys):
    make('a.dcm', BYTES, FrameTime=None)
    make('b.dcm', BYTES, 90.0, FrameTime=None)
    assert 'no file tells the rate: 15 images/s are a guess' in imported(capsys, '--dicom', 'a.dcm', 'b.dcm')
    make('b.dcm', BYTES, 90.0, FrameTime=40)
    importer.main(['--dicom', 'a.dcm', 'b.dcm', '--out', 'other'])
    assert 'plane A does not tell its rate: it is taken for that of plane B, 25/s' in capsys.readouterr().out
    assert [stamp_ns(m) for m in read('other')['/plane_a/image_raw']] == [10**9, 1_040_000_000, 1_080_000_000]


# ---- Enhanced XA


def test_the_functional_groups_of_enhanced_xa(capsys):
    """It says of every frame what a classic image says of them all: the same cameras."""
    run = dicom.read_run(enhanced('run.dcm', FRAMES, [0.0, 10.0, 10.0], [0.1, 0.2, 0.35],
                                  PlaneIdentification='PLANE B'))
    assert (run.plane, run.count) == ('b', 3) and run.calibrations[1] is run.calibrations[2]
    for angle, camera in zip((0.0, 10.0), run.calibrations):
        assert np.allclose(camera.P, dicom.read_run(make('classic.dcm', FRAMES, angle)).calibrations[0].P)
    assert run.times_ns.tolist() == [0, 100_000_000, 250_000_000]
    make('a.dcm', FRAMES, 90.0, FrameTime=100.0)
    assert '2 pairs' in imported(capsys, '--dicom', 'run.dcm', 'a.dcm')      # a.dcm does not say its plane
    written = b''.join(p.read_bytes() for p in Path('out').iterdir())
    assert not any(word.encode() in written for word in PERSON.values()) and b'20260102' not in written


def test_a_field_of_view_of_enhanced_xa():
    header = pydicom.dcmread(enhanced('run.dcm', FRAMES, [0.0] * 3))
    shared = header.SharedFunctionalGroupsSequence[0]
    del shared.FramePixelDataPropertiesSequence[0].ImagerPixelSpacing
    shared.FieldOfViewSequence = [pydicom.Dataset()]
    shared.FieldOfViewSequence[0].FieldOfViewDimensionsInFloat = [8.0 * PITCH, 10.0 * PITCH]
    header.save_as('run.dcm')
    run = dicom.read_run('run.dcm')
    assert run.calibrations[0].K[1, 1] == pytest.approx(SID / PITCH) and run.times_ns is None and len(run.notes) == 1


@pytest.mark.parametrize('angles, says', [([0.0, 1.0], 'functional groups are for 2 frames, but there are 3'),
                                          ([0.0, 1.0, None], 'PositionerPrimaryAngle is missing')])
def test_functional_groups_that_do_not_do_are_named(angles, says):
    with pytest.raises(BadDicom, match=says):
        dicom.read_run(enhanced('run.dcm', FRAMES, angles))


def test_frames_that_are_centuries_apart_are_named():
    """What a fuzzer found: nanoseconds of 64 bits hold 292 years."""
    header = pydicom.dcmread(enhanced('run.dcm', FRAMES, [0.0] * 3, [0.1, 0.2, 0.3]))
    groups = header.PerFrameFunctionalGroupsSequence
    groups[-1].FrameContentSequence[0].FrameAcquisitionDateTime = '24260102121314'
    header.save_as('run.dcm')
    with pytest.raises(BadDicom, match='run.dcm: damaged: FrameAcquisitionDateTime can\'t be read'):
        dicom.read_run('run.dcm')
