"""An interrupt while modules are imported comes after the imports."""

import os
import signal
import subprocess
import sys
import threading

import pytest

from mappo_unity.signals import interrupts_end, interrupts_wait


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


def test_an_interrupt_before_anything_is_begun_ends_with_one_line():
    code = (
        "import os, signal, time\n"
        "from mappo_unity.signals import interrupts_end\n"
        "print('printed', end='')\n"
        "with interrupts_end('mappo-eval'):\n"
        "    os.kill(os.getpid(), signal.SIGINT)\n"
        "    time.sleep(60)\n"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, timeout=30)
    assert done.returncode == 130
    assert (done.stdout, done.stderr) == ("printed", "mappo-eval: interrupted\n")


def test_after_the_block_interrupts_are_what_they_were():
    with interrupts_end("mappo-eval"):
        pass
    assert signal.getsignal(signal.SIGINT) is signal.default_int_handler


def test_a_second_interrupt_while_python_ends_adds_nothing():
    code = (
        "import atexit, os, signal, sys\n"
        "from mappo_unity import cli\n"
        "import mappo_unity.cli.eval\n"
        "def interrupted(lines):\n"
        "    raise KeyboardInterrupt\n"
        "cli.eval.run = interrupted\n"
        "atexit.register(lambda: os.kill(os.getpid(), signal.SIGINT))\n"
        "sys.argv = ['mappo-eval', 'run=a']\n"
        "sys.exit(cli.eval_main())\n"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, timeout=30)
    assert (done.returncode, done.stderr) == (130, "mappo-eval: interrupted\n")
