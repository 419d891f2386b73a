"""Ctrl-C: one line on stderr and exit code 130, whatever the command is doing."""

import os
import shutil
import signal
import socket
import sys
import threading
from collections.abc import Callable

INTERRUPTED = 130
"""Exit code of an interrupted command, by the convention of shells: 128 and the number of the signal."""
TEMPORARY: list[str] = []
"""Folders to remove before that."""
ENDINGS: list[Callable[[], object]] = []
"""What the first interrupts do instead of ending the process."""


def end_on_interrupt() -> None:
    """Make Ctrl-C end this process at once.

    A KeyboardInterrupt would not do: it waits for compilations and other long calls of libraries, some of
    which print it and go on, and can crash an import. So a thread waits for the signal.
    """
    # A shell makes jobs in the background ignore the signal.
    if signal.getsignal(signal.SIGINT) is signal.default_int_handler:
        receiver, sender = socket.socketpair()
        sender.setblocking(False)
        signal.signal(signal.SIGINT, lambda *_: None)
        signal.set_wakeup_fd(sender.fileno(), warn_on_full_buffer=False)
        threading.Thread(target=_wait, args=(receiver, sender), daemon=True).start()


def _wait(receiver: socket.socket, _: socket.socket) -> None:
    """Wait for the signal's number and end the process; keeps both sockets open."""
    while True:
        if signal.SIGINT in receiver.recv(1):
            if not ENDINGS:
                break
            ENDINGS.pop()()
    # On a terminal the line of a spinner is cleared, and the cursor shown again.
    clear = b"\r\x1b[K\x1b[?25h" if sys.stderr.isatty() else b""
    os.write(2, clear + b"interrupted\n")
    for folder in TEMPORARY:
        shutil.rmtree(folder, ignore_errors=True)
    os._exit(INTERRUPTED)
