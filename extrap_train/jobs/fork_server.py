"""The server that a process's workers are forked from: it imports what they need once."""

import multiprocessing
import os
from collections.abc import Collection
from multiprocessing import forkserver
from multiprocessing.context import ForkServerContext

from extrap_train.jobs import ONE_THREAD


def start_fork_server(preload: Collection[str]) -> ForkServerContext:
    """Start this process's server unless it runs; returns what starts processes from it.

    The server imports the modules `preload`, which must start no thread and open no GPU then. It
    holds none of this process's threads and devices, its libraries have one thread each, and it
    ends with this process. There is one per process: whoever starts it first decides what it
    imports, and its workers import the rest themselves.
    """
    context = multiprocessing.get_context("forkserver")
    context.set_forkserver_preload([*preload])
    before = dict(os.environ)
    os.environ |= dict.fromkeys(ONE_THREAD, "1")  # libraries read them as they load
    try:
        forkserver.ensure_running()
    finally:
        os.environ.clear()
        os.environ.update(before)
    return context
