"""Interrupts that may not become exceptions where they come."""

from __future__ import annotations

import signal
import subprocess
import sys

import pytest

from runtime.support.interrupts import interrupts_held

# An interrupt in the call of Python by which moderngl makes a uniform.
IN_A_UNIFORM = """
import signal, sys
from runtime.support import gl
context = gl.offscreen_context()
came = []
def traced(frame, event, argument):
    if event == "call" and frame.f_code.co_name == "make_uniform" and not came:
        came.append(True)
        signal.raise_signal(signal.SIGINT)
sys.setprofile(traced)
VERTEX = "#version 330\\nuniform float a; void main() { gl_Position = vec4(a); }"
FRAGMENT = "#version 330\\nout vec4 c; void main() { c = vec4(1); }"
try:
    %s
except KeyboardInterrupt:
    print("interrupted", came)
"""


def test_an_interrupt_while_a_program_is_linked_is_one_and_no_segmentation_fault() -> None:
    body = IN_A_UNIFORM % "gl.linked_program(context, vertex=VERTEX, fragment=FRAGMENT)"
    answer = subprocess.run([sys.executable, "-c", body], capture_output=True, text=True, timeout=60)
    assert (answer.returncode, answer.stdout) == (0, "interrupted [True]\n")


def test_what_was_begun_is_done_before_the_interrupt() -> None:
    done = []
    with pytest.raises(KeyboardInterrupt), interrupts_held():
        signal.raise_signal(signal.SIGINT)
        done.append("to its end")
    assert done and signal.getsignal(signal.SIGINT) is signal.default_int_handler


def test_whoever_takes_interrupts_gets_one() -> None:
    taken = []
    before = signal.signal(signal.SIGINT, lambda number, frame: taken.append(number))
    try:
        with interrupts_held():
            signal.raise_signal(signal.SIGINT)
            signal.raise_signal(signal.SIGINT)
            assert taken == []
        assert taken == [signal.SIGINT]
    finally:
        signal.signal(signal.SIGINT, before)
