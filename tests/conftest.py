"""What every test may rely on."""

import signal

# A shell starts background jobs with SIGINT ignored, and programs inherit that: interrupted ones would not notice.
signal.signal(signal.SIGINT, signal.default_int_handler)
