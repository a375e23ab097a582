"""The bar that `progress=True` draws."""

import sys
import time

_WIDTH = 30
_SECONDS = 0.1


class Bar:
    """Draws how far a solve has come: on a terminal and in a notebook in one line, elsewhere a line for each measurement."""

    def __init__(self, stream=None):
        self._stream = stream or sys.stderr
        self._redraws = self._stream.isatty() or "ipykernel" in sys.modules
        self._drawn = 0.0

    def __call__(self, measurement, done, iterations, psnr_db):
        ended = done >= iterations
        if not ended and (not self._redraws or time.monotonic() - self._drawn < _SECONDS):
            return
        self._drawn = time.monotonic()
        full = _WIDTH * done // max(iterations, 1)
        quality = "" if psnr_db is None else f"   {psnr_db:.2f} dB"
        line = f"measurement {measurement:>2} {'█' * full}{'░' * (_WIDTH - full)} {done}/{iterations}{quality}"
        self._stream.write(("\r" if self._redraws else "") + line + ("\n" if ended else ""))
        self._stream.flush()
