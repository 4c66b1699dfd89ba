"""Ctrl-C can be tested also where it is ignored, as in the background of a shell."""

import signal

signal.signal(signal.SIGINT, signal.default_int_handler)
