"""All metadata is here: [project] in pyproject.toml would break `colcon build --symlink-install`."""

from glob import glob
from pathlib import Path

from setuptools import find_packages, setup

NAME = 'fluoro_shape_ros'
EXECUTABLES = {
    'fluoro_shape_node': 'fluoro_shape_ros.node',
    'fluoro_shape_sim': 'fluoro_shape_ros.sim.main',
    'fluoro_shape_import': 'fluoro_shape_ros.files.importer',
    'fluoro_shape_replay': 'fluoro_shape_ros.files.replay',
    'fluoro_shape_view': 'fluoro_shape_ros.view.main',
    'fluoro_shape_calibrate': 'fluoro_shape_ros.files.calibrate',
    'fluoro_shape_bench': 'fluoro_shape_ros.bench.main',
    'fluoro_shape_demo': 'fluoro_shape_ros.demo.main',
    'fluoro_shape_servo_demo': 'fluoro_shape_ros.demo.servo',
}

# real ROS 2 Jazzy as wheels; where ROS is installed (or there are no wheels) the extra is empty
WHEELS = '; sys_platform == "linux" and platform_machine == "x86_64"'
EXTRAS = {
    'ros': [f'{name}{WHEELS}' for name in ('ros-jazzy-rclpy', 'ros-jazzy-common-interfaces',
                                           'ros-jazzy-rmw-fastrtps-cpp')],
    'bags': ['rosbags>=0.10', 'mcap>=1.2', 'zstandard>=0.22', 'pyyaml>=6.0'],
    'report': ['plotly>=5.18'],
    'dicom': ['pydicom>=3.0.1', 'python-gdcm>=3.0.24.1'],   # GDCM decodes the lossless JPEG that most angiographs write
    'vtk': ['vtk>=9.3'],
    'gvxr': ['gvxr>=2.1' + WHEELS],
    'plot': ['matplotlib>=3.6'],
    'cluster': ['distributed>=2024.2'],
    'view': ['rerun-sdk>=0.23.1'],     # 0.23.1 is the last release for numpy 1.26
}
EXTRAS['demo'] = EXTRAS['ros'] + EXTRAS['plot']
EXTRAS['all'] = sorted({requirement for extra in EXTRAS.values() for requirement in extra})
# in place of Jazzy: one venv holds one of them
EXTRAS['ros-kilted'] = [name.replace('jazzy', 'kilted') for name in EXTRAS['ros']]
# atheris has wheels for these only, and its sources need clang
EXTRAS['fuzz'] = ['atheris>=3.0' + WHEELS + ' and python_version < "3.14"', *EXTRAS['bags'], *EXTRAS['dicom']]
EXTRAS['docs'] = ['sphinx>=8.0', 'myst-parser>=4.0', 'furo>=2024.8.6', *EXTRAS['bags']]
EXTRAS['test'] = [*EXTRAS['all'], *EXTRAS['fuzz'], 'pytest>=7.4', 'hypothesis>=6.98']

SHARED = sorted(path for kind in ('xml', 'yaml', 'rviz', 'json', 'html', 'py') for path in glob(f'resource/*.{kind}'))

setup(
    name=NAME,
    version='0.1.0',
    description='3-D backbone and tip of a continuum robot, needle or catheter from biplane fluoroscopy, live on ROS 2',
    long_description=(Path(__file__).resolve().parent / 'README.md').read_text(encoding='utf-8'),
    long_description_content_type='text/markdown',
    author='fluoro_shape_ros maintainers',
    author_email='maintainers@fluoro-shape.example',
    maintainer='fluoro_shape_ros maintainers',
    maintainer_email='maintainers@fluoro-shape.example',
    license='Apache-2.0',
    classifiers=[f'Programming Language :: Python :: 3.{minor}' for minor in (11, 12, 13)],   # with which .ci/run tests
    keywords=['ROS', 'fluoroscopy', 'continuum robot', 'shape sensing'],
    packages=find_packages(include=[f'{NAME}*', 'msg_adapters*']),
    data_files=[
        ('share/ament_index/resource_index/packages', [f'resource/{NAME}']),
        (f'share/{NAME}', ['package.xml', *SHARED]),
        # `ros2 run` looks in lib/<package>; pip puts the entry points below in bin/ only
        (f'lib/{NAME}', [f'resource/bin/{name}' for name in EXECUTABLES]),
    ],
    entry_points={'console_scripts': [f'{name} = {module}:main' for name, module in EXECUTABLES.items()]},
    python_requires='>=3.11',
    install_requires=['numpy>=1.26.4', 'scipy>=1.11.4', 'opencv-python-headless>=4.6', 'scikit-image>=0.22',
                      'tqdm>=4.60', 'pyyaml>=6.0'],
    extras_require=EXTRAS,
    zip_safe=True,
)
