"""Runs until SIGINT, even where it was started with that signal ignored, as jobs in the background are."""

import signal
import time

if __name__ == "__main__":
    signal.signal(signal.SIGINT, signal.default_int_handler)
    print("running", flush=True)
    time.sleep(600.0)
