"""Calibrations as other programs write them: the same two cameras in every format, with P = K [R | t] worked out
here."""

from pathlib import Path

import cv2
import numpy as np
import pytest
import scipy.io

yaml = pytest.importorskip('yaml')

from scipy.spatial.transform import Rotation

from fluoro_shape_ros.geometry.cameras import distort, make_view, project, undistort
from msg_adapters.calibration import BadCalibration, Calibration, write_calibration
from msg_adapters.calibration_files import in_metres, read_cameras
from msg_adapters.cameras import BadCameraInfo, camera_info_to_view, check_lengths
from msg_adapters.messages import bag_message, ros_message

SIZE = 640, 480
K1 = np.array([[1500.0, 0, 321.5], [0, 1490, 242.25], [0, 0, 1]])
K2 = np.array([[1600.0, 0, 310.25], [0, 1610, 250.5], [0, 0, 1]])
D1, D2 = np.array([-0.2, 0.05, 1e-3, -2e-3, 0.01]), np.array([0.1, -0.03, 2e-3, 1e-3, 0.0])
R = Rotation.from_euler('yxz', [80, 5, -3], degrees=True).as_matrix()
T = np.array([-0.62, 0.01, 0.5])        # m
P1, P2 = K1 @ np.eye(3, 4), K2 @ np.c_[R, T]


@pytest.fixture(autouse=True)
def here(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)


def planes(*paths, unit=''):
    """The calibrations of both planes from one source, and what is said of them."""
    found = read_cameras(*paths)
    assert len(found) == 2
    return *(in_metres(found, unit)[0]), in_metres(found, unit)[1]


def check(a, b, size=SIZE, distorted=True):
    assert (a.width, a.height) == (b.width, b.height) == size
    for c, K, P, D in ((a, K1, P1, D1), (b, K2, P2, D2)):
        assert np.allclose(c.K, K) and np.allclose(c.P, P)
        assert np.allclose(c.D, D) if distorted else not np.any(c.D)


# ---- OpenCV


def file_storage(name, **values):
    storage = cv2.FileStorage(name, cv2.FILE_STORAGE_WRITE)
    for key, value in values.items():
        storage.write(key, value)
    storage.release()
    return name


OPENCV = dict(M1=K1, D1=D1, M2=K2, D2=D2, R=R, T=T)


@pytest.mark.parametrize('suffix', ['yml', 'yaml', 'xml', 'json'])
def test_a_stereo_pair_of_opencvs_file_storage(suffix):
    a, b, said = planes(file_storage(f'stereo.{suffix}', **OPENCV, image_width=640, image_height=480, R1=np.eye(3),
                                     P1=P1, Q=np.eye(4)))
    check(a, b)
    assert not said


def test_intrinsics_and_extrinsics_in_two_files_as_stereo_calib_writes_them():
    first = file_storage('intrinsics.yml', M1=K1, D1=D1, M2=K2, D2=D2)
    second = file_storage('extrinsics.yml', R=R, T=T.reshape(3, 1) * 1e3, R1=np.eye(3), R2=np.eye(3), P1=P1, P2=P2)
    a, b, said = planes(first, second)
    check(a, b, (0, 0))
    assert 'in mm, as a source stands 796' in said
    with pytest.raises(BadCalibration, match='intrinsics.yml: has two cameras, but not R and T'):
        read_cameras(first)


@pytest.mark.parametrize('names', [
    dict(K1='K1', D1='D1', K2='K2', D2='D2', R='R', T='T'),
    dict(K1='mtx_left', D1='dist_left', K2='mtx_right', D2='dist_right', R='R', T='T'),
    dict(K1='mtxL', D1='distL', K2='mtxR', D2='distR', R='Rot', T='trans'),
    dict(K1='cameraMatrix1', D1='distCoeffs1', K2='cameraMatrix2', D2='distCoeffs2', R='R', T='T'),
    dict(K1='intrinsics1', D1='distortion1', K2='intrinsics2', D2='distortion2', R='R', T='T'),
    dict(K1='left_camera_matrix', D1='left_dist_coeffs', K2='right_camera_matrix', D2='right_dist_coeffs',
         R='rotation_matrix', T='translation_vector'),
    dict(K1='K_a', D1='D_a', K2='K_b', D2='D_b', R='R', T='T'),
    dict(K1='K0', D1='D0', K2='K1', D2='D1', R='R', T='T'),
], ids=lambda names: names['K1'])
@pytest.mark.parametrize('kind', ['npz', 'mat'])
def test_matrices_by_whatever_name(names, kind):
    values = {names[key]: value
              for key, value in dict(K1=K1, D1=D1[None], K2=K2, D2=D2[None], R=R, T=T[:, None]).items()}
    if kind == 'npz':
        np.savez('stereo.npz', **values, image_size=np.array(SIZE), E=np.eye(3))
    else:
        scipy.io.savemat('stereo.mat', values | dict(image_size=np.array(SIZE)))
    check(*planes(f'stereo.{kind}')[:2])


def test_a_camera_by_itself_stands_in_the_reference_frame():
    np.savez('b.npz', mtx=K2, dist=D2, rvec=Rotation.from_matrix(R).as_rotvec(), tvec=T,
             img_shape=np.array([480, 640, 3]))
    file_storage('b.xml', camera_matrix=K2, distortion_coefficients=D2, R=R, T=T, image_width=640, image_height=480)
    for name in ('b.npz', 'b.xml'):
        (found,) = read_cameras(name)
        assert np.allclose(found.calibration.P, P2) and np.allclose(found.calibration.D, D2)
        assert (found.calibration.width, found.calibration.height) == SIZE


@pytest.mark.parametrize('D, extra, model', [(np.zeros(5), {}, 'plumb_bob'),
                                             (np.arange(8.0), {}, 'rational_polynomial'),
                                             (np.arange(14.0), {}, 'rational_polynomial'),
                                             (np.arange(4.0), dict(fisheye_model=1), 'equidistant'),
                                             (np.arange(4.0), dict(distortion_model='fisheye'), 'fisheye')])
def test_the_model_is_told_by_the_number_of_coefficients(D, extra, model):
    found = read_cameras(file_storage('c.yml', K=K1, D=D, R=R, T=T, **extra))[0]
    assert found.calibration.distortion_model == model and np.array_equal(found.calibration.D, D)


# ---- X-ray labs


def mayacam(name, K, R, t):
    row = lambda values: ','.join(f'{v:.12g}' for v in values)       # noqa: E731
    parts = ['image size', '640,480', '', 'camera matrix', *map(row, K), '', 'rotation', *map(row, R), '',
             'translation', *(f'{v:.12g}' for v in t), '']
    Path(name).write_bytes('\r\n'.join(parts).encode())
    return name


def test_mayacam_2_of_xmalab_in_millimetres():
    found = [read_cameras(mayacam('a.txt', K1, np.eye(3), [0, 0, 900.0]))[0],
             read_cameras(mayacam('b.txt', K2, R, 1e3 * T))[0]]
    (a, b), said = in_metres(found)
    assert np.allclose(a.P, K1 @ np.c_[np.eye(3), [0, 0, 0.9]]) and np.allclose(b.P, P2) and (a.width, a.height) == SIZE
    assert said == 'the calibrations are in mm, as a source stands 900 from the origin; --unit says otherwise'
    (a, b), said = in_metres(found, 'cm')
    assert np.allclose(a.P, K1 @ np.c_[np.eye(3), [0, 0, 9.0]]) and not said


def test_a_vtk_camera_of_autoscoper():
    """From 800 mm behind the origin along y it looks along y with z up: u runs with x, v against z, and 30 degrees fill
    either side."""
    Path('cam.txt').write_text('# VTK\nversion: 1.0\ncamera-position: 0,-800,0\nfocal-point: 0,0,0\nview-up: 0,0,1\n'
                               'view-angle: 30\nimage-width: 640\nimage-height: 640\n')
    (c,), said = in_metres(read_cameras('cam.txt'))
    f = 320 / np.tan(np.pi / 12)
    assert 'in mm' in said and np.allclose(project(c.P, np.zeros(3)), 319.5)
    assert (np.allclose(project(c.P, np.array([0.1, 0, 0])) - 319.5, [f / 8, 0])
            and np.allclose(project(c.P, np.array([0, 0, 0.1])) - 319.5, [0, -f / 8]))


# ---- MATLAB


def stereo_struct(**changes):
    """What toStruct gives, all lengths in mm; MATLAB counts pixels from 1 and multiplies rows from the left."""
    def camera(K, D):
        one_based = K + [[0, 0, 1], [0, 0, 1], [0, 0, 0]]
        return dict(RadialDistortion=D[[0, 1, 4]], TangentialDistortion=D[2:4], ImageSize=np.array([480.0, 640.0]),
                    IntrinsicMatrix=one_based.T, WorldUnits='millimeters', NumRadialDistortionCoefficients=3)
    return dict(CameraParameters1=camera(K1, D1), CameraParameters2=camera(K2, D2), RotationOfCamera2=R.T,
                TranslationOfCamera2=1e3 * T) | changes


@pytest.mark.parametrize('nested', [False, True])
def test_matlabs_stereo_parameters_as_a_struct(nested):
    scipy.io.savemat('stereo.mat', dict(stereoParams=stereo_struct()) if nested else stereo_struct())
    a, b, said = planes('stereo.mat')
    check(a, b)
    assert said == 'the calibrations are in mm, as the file says'


def test_matlab_since_2022_has_k_as_opencv():
    s = stereo_struct()
    for number, K in ((1, K1), (2, K2)):
        s[f'CameraParameters{number}'] |= dict(K=K + [[0, 0, 1], [0, 0, 1], [0, 0, 0]], RadialDistortion=np.zeros(2),
                                               TangentialDistortion=np.zeros(2), WorldUnits='m')
        del s[f'CameraParameters{number}']['IntrinsicMatrix']
    s['TranslationOfCamera2'] = T
    scipy.io.savemat('stereo.mat', s)
    a, b, said = planes('stereo.mat')
    check(a, b, distorted=False)
    assert not said


def test_an_object_of_matlab_is_named_with_what_to_do():
    scipy.io.savemat('stereo.mat', {})
    with pytest.raises(BadCalibration, match=r'stereo.mat: has an object .* toStruct\(stereoParams\)'):
        read_cameras('stereo.mat')
    Path('new.mat').write_bytes(b'MATLAB 7.3 MAT-file' + bytes(600))
    with pytest.raises(BadCalibration, match='-v7'):
        read_cameras('new.mat')


# ---- Kalibr and ROS


def camchain(**changes):
    one = dict(camera_model='pinhole', distortion_model='radtan', resolution=list(SIZE), rostopic='/a')
    pose = np.eye(4)
    pose[:3, :3], pose[:3, 3] = R, T
    content = dict(cam0=one | dict(intrinsics=K1[[0, 1, 0, 1], [0, 1, 2, 2]].tolist(),
                                   distortion_coeffs=D1[:4].tolist()),
                   cam1=one | dict(intrinsics=K2[[0, 1, 0, 1], [0, 1, 2, 2]].tolist(),
                                   distortion_coeffs=D2[:4].tolist(), T_cn_cnm1=pose.tolist()))
    content['cam1'] |= changes
    Path('camchain.yaml').write_text(yaml.safe_dump(content))
    return 'camchain.yaml'


def test_kalibrs_camchain():
    a, b, said = planes(camchain())
    assert np.allclose(a.P, P1) and np.allclose(b.P, P2) and np.allclose(b.D, D2[:4]) and not said
    assert (a.camera_name, a.distortion_model, a.width, a.height) == ('cam0', 'plumb_bob', *SIZE)
    assert read_cameras(camchain(distortion_model='equidistant'))[1].calibration.distortion_model == 'equidistant'
    with pytest.raises(BadCalibration, match='cam1 is omni'):
        read_cameras(camchain(camera_model='omni'))
    with pytest.raises(BadCalibration, match='cam1 needs intrinsics'):
        read_cameras(camchain(T_cn_cnm1=[1, 2]))


# a baseline of 60 mm, as camera_calibration writes it for the right camera
RECTIFIED = K1 @ np.eye(3, 4) - [[0, 0, 0, 90.0], [0] * 4, [0] * 4]


def test_ros_stereo_files():
    turn = Rotation.from_rotvec([0.01, 0.02, 0]).as_matrix()
    for name, K, P in (('left', K1, P1), ('right', K2, RECTIFIED)):
        write_calibration(f'{name}.yaml', Calibration(f'narrow_stereo/{name}', *SIZE, K, P, 'plumb_bob', D1, turn))
    text = ['# oST version 5.0 parameters', '', '[image]', '', 'width', '640', '', 'height', '480']
    for name, K, P in (('left', K1, P1), ('right', K2, RECTIFIED)):
        text += ['', f'[narrow_stereo/{name}]', '']
        for key, matrix in (('camera matrix', K), ('distortion', D1[None]), ('rectification', turn), ('projection', P)):
            text += [key, *(' '.join(f'{v:.9f}' for v in row) for row in matrix), '']
    Path('ost.txt').write_text('\n'.join(text))
    files = [read_cameras('left.yaml')[0], read_cameras('right.yaml')[0]]
    for found in (files, read_cameras('ost.txt')):
        (a, b), said = in_metres(found)
        assert not said and np.allclose(a.P, P1) and np.allclose(b.P, RECTIFIED)
        assert np.allclose(b.R, turn, atol=1e-8) and np.allclose(b.D, D1) and (b.width, b.height) == SIZE


def test_millimetres_in_camera_info_yaml_are_recognized():
    write_calibration('b.yaml', Calibration('b', *SIZE, K2, K2 @ np.c_[R, 1e3 * T]))
    (b,), said = in_metres(read_cameras('b.yaml'))
    assert np.allclose(b.P, P2) and 'in mm' in said


# ---- what is none


@pytest.mark.parametrize('data, says', [
    (b'', 'no calibration'),
    (b'hello', 'no calibration'),
    (b'image size\n640,480\ncamera matrix\n1,2\n', 'MayaCam 2.0: camera matrix has 2 numbers instead of 9'),
    (b'1,2,3\n' * 5, 'MayaCam 1.0'),
    (b'%YAML:1.0\n---\nK: !!opencv-matrix\n   rows: 3\n   cols: 3\n   dt: d\n   data: [1, 2', 'OpenCV'),
    (b'%YAML:1.0\n---\nthing: 3\n', 'no K, D, R and T .* it has thing'),
    (b'<?xml version="1.0"?>\n<opencv_storage>\n<broken', 'OpenCV'),
    (b'PK\x03\x04' + bytes(50), 'npz'),
    (b'MATLAB 5.0 MAT-file' + bytes(200), 'MAT'),
    (b'[image]\nwidth\n640\n', 'no camera with a projection'),
    (b'version: 1.0\ncamera-position: 1,2\n', 'VTK camera: camera-position has 2 numbers'),
    (b'cam0: {camera_model: pinhole}\n', 'cam0 needs intrinsics'),
    (b'- ' * 5000, 'no YAML|no calibration'),
    (b'%YAML:1.0\n---\nK: abc\nR: abc\nT: 3\n', 'no number, or no matrix'),
    (b'image size\n1e999,480\ncamera matrix\n' + b'1,2,3\n' * 3
     + b'rotation\n1,0,0\n0,1,0\n0,0,1\ntranslation\n1\n2\n3\n', 'no number, or no matrix'),
])
def test_what_is_no_calibration_is_named_in_one_line(data, says):
    Path('c.txt').write_bytes(data)
    with pytest.raises(BadCalibration, match=says) as error:
        read_cameras('c.txt')
    assert '\n' not in str(error.value) and str(error.value).startswith('c.txt: ')


@pytest.mark.parametrize('value', [np.nan, np.inf, 0.0])
def test_a_projection_that_is_none_is_for_others_to_name(value):
    write_calibration('b.yaml', Calibration('b', *SIZE, K2, np.full((3, 4), value)))
    (b,), said = in_metres(read_cameras('b.yaml'))
    assert np.array_equal(b.P, np.full((3, 4), value), equal_nan=True) and not said


def test_garbage_never_ends_in_another_error():
    np.savez('good.npz', K1=K1, K2=K2, R=R, T=T)
    scipy.io.savemat('good.mat', stereo_struct())
    file_storage('good.xml', **OPENCV)
    camchain()
    mayacam('good.txt', K1, R, T)
    rng = np.random.default_rng(2)
    for name in ('good.npz', 'good.mat', 'good.xml', 'camchain.yaml', 'good.txt'):
        data = Path(name).read_bytes()
        for _ in range(25):
            broken = bytearray(data)
            start = rng.integers(0, len(data) - 6)
            broken[start:start + 6] = rng.bytes(6)
            Path('bad').write_bytes(broken)
            try:
                read_cameras('bad')
            except BadCalibration as error:
                assert '\n' not in str(error)


# ---- distortion in a CameraInfo


@pytest.fixture(params=['ros', 'bag'])
def info(request):
    """A function that makes a CameraInfo with a distortion."""
    if request.param == 'ros':
        pytest.importorskip('rclpy')
        new = ros_message
    else:
        typesys = pytest.importorskip('rosbags.typesys')
        new = bag_message(typesys.get_typestore(typesys.Stores.ROS2_JAZZY))
    return lambda model, D: new('sensor_msgs/msg/CameraInfo', width=640, height=480, k=K1, p=P2, r=np.eye(3),
                                distortion_model=model, d=np.array(D, float))


@pytest.mark.parametrize('model', ['', 'plumb_bob', 'rational_polynomial', 'equidistant', 'fisheye', 'none',
                                   'thin_prism_fisheye'])
@pytest.mark.parametrize('count', [0, 1, 4, 5, 8, 12, 14, 20])
def test_zeros_are_a_pinhole_whatever_the_model_or_their_number(info, model, count):
    message = info(model, np.zeros(count))
    check_lengths(message, 'a')
    assert camera_info_to_view(message, 'a', (480, 640)).distortion is None


@pytest.mark.parametrize('model, D, known', [
    ('plumb_bob', [*D1, 0, 0, 0], D1),
    ('plumb_bob', [*D1, *[0] * 9], D1),
    ('rational_polynomial', [-0.2, 0.05, 1e-3, -2e-3, 0.01, 0.1, 0.01, 0.001], None),
    ('rational_polynomial', [-0.2, 0.05, 1e-3, -2e-3, 0.01, 0.1, 0.01, 0.001, 2e-3, 1e-4, -1e-3, 1e-4], None),
    ('rational_polynomial', [-0.2, 0.05, 1e-3, -2e-3, 0.01, 0.1, 0.01, 0.001, 2e-3, 1e-4, -1e-3, 1e-4, 0.01, -0.02],
     None),
    ('fisheye', [0.1, -0.02, 1e-3, 1e-4], None),
    ('equidistant', [0.1, -0.02, 1e-3, 1e-4, 0], [0.1, -0.02, 1e-3, 1e-4]),
], ids=lambda value: value if isinstance(value, str) else '')
def test_all_lengths_that_opencv_knows(info, model, D, known):
    view = camera_info_to_view(info(model, D), 'a', (480, 640))
    assert (np.array_equal(view.distortion.D, D if known is None else known)
            and view.distortion.model == model.replace('fisheye', 'equidistant'))
    points = np.random.default_rng(0).uniform([50, 50], [590, 430], (50, 2))
    assert np.abs(undistort(view, distort(view, points)) - points).max() < 0.01
    assert np.abs(distort(view, points) - points).max() > 0.5


def test_coefficients_that_no_model_has_are_refused(info):
    for D in (np.zeros(1000), [0.1] * 15):
        with pytest.raises(BadCameraInfo, match='D has (1000|15) coefficients, more than 14'):
            check_lengths(info('plumb_bob', D), 'a')
    with pytest.raises(BadCameraInfo, match='plumb_bob has 8 coefficients instead of 4 or 5'):
        camera_info_to_view(info('plumb_bob', [*D1, 0, 0, 0.1]), 'a', (480, 640))


def test_the_view_of_a_pair_that_was_read_is_that_camera(info):
    """A point seen by the second camera, distorted by OpenCV, comes back at P's pixel."""
    np.savez('stereo.npz', K1=K1, D1=D1, K2=K2, D2=D2, R=R, T=T)
    b = planes('stereo.npz')[1]
    X = np.array([[0.02, 0.01, 0.6], [0.0, -0.03, 0.55]])
    seen = cv2.projectPoints(X, cv2.Rodrigues(R)[0], T, K2, D2)[0][:, 0]
    message = info('plumb_bob', D2)
    message.k, message.p = b.K.ravel(), b.P.ravel()
    view = camera_info_to_view(message, 'b', (480, 640))
    assert np.abs(undistort(view, seen) - project(make_view('b', P2, *SIZE).P, X)).max() < 1e-3
