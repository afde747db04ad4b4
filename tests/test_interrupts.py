"""An interrupt while modules are imported comes after the imports."""

import os
import signal
import threading

import pytest

from mappo_unity.interrupts import interrupts_wait


def test_an_interrupt_comes_after_the_block():
    done = []
    with pytest.raises(KeyboardInterrupt), interrupts_wait():
        os.kill(os.getpid(), signal.SIGINT)
        done.append(1)
    assert done == [1]
    assert signal.getsignal(signal.SIGINT) is signal.default_int_handler


def test_another_handler_gets_it_too():
    got = []
    previous = signal.signal(signal.SIGINT, lambda number, frame: got.append(number))
    try:
        with interrupts_wait():
            os.kill(os.getpid(), signal.SIGINT)
            assert not got
        assert got == [signal.SIGINT]
    finally:
        signal.signal(signal.SIGINT, previous)


def test_an_error_of_the_block_is_not_hidden_and_other_threads_do_nothing():
    with pytest.raises(ImportError), interrupts_wait():
        raise ImportError("no such module")

    def elsewhere():
        with interrupts_wait():
            ran.append(1)

    ran = []
    thread = threading.Thread(target=elsewhere)
    thread.start()
    thread.join()
    assert ran == [1]
