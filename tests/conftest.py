"""What every test may rely on."""

import os
import signal

# Read when numpy is first imported. Threads of BLAS on matrices of three rows wait for each other and for the cores
# that the other test process uses; the command line sets the same.
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

os.environ.setdefault("MPLBACKEND", "agg")

# A shell starts background jobs with SIGINT ignored, and programs inherit that: interrupted ones would not notice.
signal.signal(signal.SIGINT, signal.default_int_handler)
