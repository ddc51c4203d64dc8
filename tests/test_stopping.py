"""Who asks to stop is heard at once, also while a long recording is skipped."""

from __future__ import annotations

import signal
import subprocess
import sys
import time
from pathlib import Path

CODE = """
import sys
from runtime.clock import SimulatedClock
from runtime.daemon.signals import Signals
from runtime.errors import Stopped
from runtime.sensor.replay import ReplayDriver
from runtime.support import progress

with Signals() as signals:
    def heard(what, done, total):
        if done:
            print("skipping", flush=True)
        if signals.stop:
            raise Stopped(signals.stop)
    try:
        with progress.listening(heard):
            ReplayDriver(sys.argv[1], SimulatedClock(), start_s=20_000).open()
    except Stopped as why:
        sys.exit(f"stopped by {why}")
"""


def test_sigterm_ends_the_skipping_of_a_long_recording(tmp_path: Path) -> None:
    from mcap.writer import Writer

    path = tmp_path / "long.mcap"
    with path.open("wb") as file:
        writer = Writer(file)
        writer.start()
        header = {"schema_version": "1", "driver": "test", "eye_points": "1"}
        writer.add_metadata("phasestack.recording", header)
        channel = writer.register_channel("/eyes", "json", writer.register_schema("s", "jsonschema", b"{}"))
        for k in range(400_000):
            data = b'{"sequence":%d,"capture_ns":%d,"eyes_m":null}' % (k + 1, 1000 * k)
            writer.add_message(channel, k, data, k)
        writer.finish()
    process = subprocess.Popen(
        [sys.executable, "-c", CODE, str(path)], stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True
    )
    assert process.stdout.readline() == "skipping\n"
    start = time.monotonic()
    process.send_signal(signal.SIGTERM)
    told = process.stderr.read()
    assert process.wait(60) == 1 and told == "stopped by SIGTERM\n"
    assert time.monotonic() - start < 20  # all of it takes minutes
    process.stdout.close()
    process.stderr.close()
