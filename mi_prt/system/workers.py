"""A thread beside the calling one, where Mitsuba waits for one.

OpenEXR hands each block of lines to Dr.Jit's workers and waits for them without working itself.
With one thread (`--threads 1`, one core) there is no worker, and reading or writing an .exr never
ends. Nothing else of Mitsuba waits so: other formats, scenes without images and kernels are done by
the calling thread.
"""

import threading
from contextlib import contextmanager

from .runtime import set_thread_count, thread_count

_lock = threading.Lock()
_inside = 0
_before = 1


@contextmanager
def a_worker_at_least():
    """Within the block Dr.Jit has a thread beside the calling one.

    Blocks may be nested and overlap in several threads: the last one to end takes the worker away.
    """
    global _inside, _before
    with _lock:
        if _inside == 0:
            _before = thread_count()
            set_thread_count(max(_before, 2))
        _inside += 1
    try:
        yield
    finally:
        with _lock:
            _inside -= 1
            if _inside == 0:
                set_thread_count(_before)
