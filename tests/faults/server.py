"""Runs caustic commands in forked children of a process that has everything loaded already, so that they begin at once.

Reads a JSON pair a line, arguments and the seconds after which the child is killed (or null); answers with its exit code.
`board` (argv[1]) is a file of doubles shared with whoever asks: the time at which each iteration was done, by its number.
"""

import json
import mmap
import os
import signal
import struct
import sys
import time

import torch
import torch._dynamo

from caustic_cli import cli
from caustic_cli.commands import export, render  # noqa: F401
from caustic_cli.export import lighttools, stl  # noqa: F401
from caustic_cli.inverse.designer import Designer

torch.set_num_threads(1)
with open(sys.argv[1], "r+b") as f:
    board = mmap.mmap(f.fileno(), 0)
run = Designer.run


def told(self, state, *, on_iteration=lambda s: None, **rest):
    def tell(now):
        if 8 * now.total + 8 <= len(board):
            board[8 * now.total : 8 * now.total + 8] = struct.pack("d", time.monotonic())
        on_iteration(now)

    return run(self, state, on_iteration=tell, **rest)


Designer.run = told
for line in sys.stdin:
    arguments, after = json.loads(line)
    pid = os.fork()
    if pid == 0:
        os.dup2(os.open(sys.argv[2], os.O_WRONLY | os.O_CREAT | os.O_TRUNC), 2)
        os.dup2(2, 1)
        code = 99
        try:
            code = cli.run(arguments)
        finally:
            os._exit(code)
    if after is not None:
        time.sleep(after)
        os.kill(pid, signal.SIGKILL)  # nobody has waited for it, so the number is still its own
    print(os.waitstatus_to_exitcode(os.waitpid(pid, 0)[1]), flush=True)
