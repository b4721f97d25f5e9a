from setuptools import find_packages, setup
setup(name='fluoro_shape_ros', version='0.1.0', packages=find_packages(exclude=['test', 'test.*']))
