"""fluoro_shape_ros: the 3-D backbone and tip of a thin device from two X-ray views."""

import os

# before numpy is imported: the many small matrix products of a fit gain nothing from OpenBLAS' threads, which spin
# while they wait; measured, a fit took ten times as long where two processes did so on two cores
os.environ.setdefault('OPENBLAS_NUM_THREADS', '1')

__version__ = '0.1.0'
