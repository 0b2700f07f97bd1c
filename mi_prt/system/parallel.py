"""NumPy work on all cores: threads over chunks, with BLAS itself on one thread.

A threaded BLAS waits at a barrier after every product. On the small products of this program that
gains little on an idle machine, and on a busy one each barrier costs a time slice: products of one
millisecond were measured to take sixteen.
"""

from concurrent.futures import ThreadPoolExecutor
from functools import cache

from .runtime import thread_count

# rows of transport worked on at a time: a block of a few MB stays in the processor's cache
BLOCK_ROWS = 128


def map_chunks(function, chunks):
    """Results of `function` on each chunk, in order; chunks run on `runtime.thread_count()`
    threads.
    """
    with one_blas_thread(), ThreadPoolExecutor(thread_count()) as pool:
        yield from pool.map(function, chunks)


def one_blas_thread():
    """A context in which BLAS runs on the calling thread alone."""
    return _controller().limit(limits=1, user_api="blas")


@cache
def _controller():
    from threadpoolctl import ThreadpoolController

    return ThreadpoolController()
