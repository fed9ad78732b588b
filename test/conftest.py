"""What every test starts from."""

import signal

# a background job of a shell that is not interactive begins with SIGINT ignored, and would hand that on to what is under test
signal.signal(signal.SIGINT, signal.default_int_handler)
