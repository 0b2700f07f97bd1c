"""NumPy work on all cores: threads over chunks, with BLAS itself on one thread.

A threaded BLAS waits at a barrier after every product. On the small products of this program that
gains little on an idle machine, and on a busy one each barrier costs a time slice: products of one
millisecond were measured to take sixteen.
"""

from collections import deque
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from functools import cache
from threading import Lock

from .runtime import thread_count

# rows of transport worked on at a time: a block of a few MB stays in the processor's cache
BLOCK_ROWS = 128


AHEAD = 2  # chunks for each thread that may be done before their results are taken


def map_chunks(function, chunks, most=None):
    """Results of `function` on each chunk, in order; chunks run on `runtime.thread_count()`
    threads.

    Parameters
    ----------
    function : callable(chunk)
    chunks : iterable
        Taken as they are needed.
    most : int, optional
        Chunks that are worked on, or done and not yet taken, at a time: what bounds their memory,
        on any number of cores. By default twice as many as threads.
    """
    threads = thread_count()
    most = max(1, most or AHEAD * threads)
    with one_blas_thread(), ThreadPoolExecutor(min(threads, most)) as pool:
        waiting = deque()
        try:
            for chunk in chunks:
                waiting.append(pool.submit(function, chunk))
                if len(waiting) >= most:
                    yield waiting.popleft().result()
            while waiting:
                yield waiting.popleft().result()
        finally:
            for future in waiting:
                future.cancel()


_lock = Lock()
_users, _before = 0, []


@contextmanager
def one_blas_thread():
    """Within the block BLAS runs on the calling thread alone.

    The number of its threads is one of the process. Blocks may be nested and overlap in several
    threads: the first to begin sets it, the last to end sets it back.
    """
    global _users, _before
    with _lock:
        if _users == 0:
            _before = [library.num_threads for library in _blas()]
            _set([1] * len(_before))
        _users += 1
    try:
        yield
    finally:
        with _lock:
            _users -= 1
            if _users == 0:
                _set(_before)


def _set(counts):
    """Set the threads of each library, from any thread: threadpoolctl from 3.8 on lets OpenBLAS be
    set by one thread alone until that ends, and does nothing for the others.
    """
    for library, count in zip(_blas(), counts):
        getattr(library, "_real_set_num_threads", library.set_num_threads)(count)


@cache
def _blas():
    """Libraries of BLAS that the process has: NumPy and SciPy each bring one."""
    import scipy.linalg.blas  # noqa: F401  (what is loaded later would not be among them)
    from threadpoolctl import ThreadpoolController

    return ThreadpoolController().select(user_api="blas").lib_controllers
