"""Bounds of memory and threads: what is in flight, BLAS of the process, what is said before the
rays.
"""

import threading
import time

import numpy as np
import pytest
from conftest import cube, rectangle, scene

import mi_prt
from mi_prt.basis import pca
from mi_prt.errors import SettingsError
from mi_prt.precompute import distant_forecast, distant_pilot
from mi_prt.precompute.plan import make_plan
from mi_prt.precompute.precompute import begin
from mi_prt.precompute.settings import Settings
from mi_prt.scene.scene import open_scene
from mi_prt.system import parallel, runtime

SETTINGS = {"directions": "cubemap:8", "edge_length": 0.2, "bounces": 0}


def blas_threads():
    return [library.num_threads for library in parallel._blas()]


@pytest.fixture
def two_blas_threads():
    """BLAS on two threads, whatever the machine has."""
    before = blas_threads()
    parallel._set([2] * len(before))
    yield
    parallel._set(before)


# --- chunks ---------------------------------------------------------------------------------------


@pytest.mark.parametrize(("threads", "most"), [(1, None), (2, None), (3, 1), (2, 3)])
def test_a_bounded_number_of_chunks_is_in_flight(threads, most):
    """A consumer that is slower than the threads: no more results wait for it than said, chunks are
    not taken ahead, and results are those of all in order.
    """
    started, taken, waiting = [], [], []
    before = runtime.thread_count()

    def chunks():
        for number in range(40):
            taken.append(number)
            yield number

    try:
        runtime.set_threads(threads)
        results = []
        for result in parallel.map_chunks(lambda n: started.append(n) or n * n, chunks(), most):
            time.sleep(0.002)
            waiting.append(len(started) - len(results))
            assert len(taken) - len(results) <= (most or parallel.AHEAD * threads)
            results.append(result)
    finally:
        runtime.set_threads(before)
    assert results == [n * n for n in range(40)]
    assert max(waiting) <= (most or parallel.AHEAD * threads)


def test_chunks_after_a_failed_one_are_not_begun(two_blas_threads):
    begun = []

    def work(number):
        begun.append(number)
        if number == 3:
            raise ZeroDivisionError

    with pytest.raises(ZeroDivisionError):
        list(parallel.map_chunks(work, range(1000)))
    assert len(begun) <= 4 + parallel.AHEAD * runtime.thread_count()
    assert set(blas_threads()) == {2}


# --- BLAS -----------------------------------------------------------------------------------------


def test_threads_that_relight_at_once_leave_blas_as_it_was(two_blas_threads):
    """The first begins before and ends before the second, so each would set back what the other
    had found.
    """
    inside = [threading.Event() for _ in range(2)]
    leave = [threading.Event() for _ in range(2)]

    def work(i):
        with parallel.one_blas_thread():
            inside[i].set()
            leave[i].wait(10)

    workers = [threading.Thread(target=work, args=(i,)) for i in range(2)]
    for i in range(2):
        workers[i].start()
        inside[i].wait(10)
    assert set(blas_threads()) == {1}
    for i in range(2):
        leave[i].set()
        workers[i].join()
        assert set(blas_threads()) == {(1, 2)[i]}


def test_many_threads_relight(two_blas_threads):
    asset = mi_prt.precompute(scene(a=rectangle(), b=cube((0, 0.5, 0), 0.3)), **SETTINGS)
    light = np.random.default_rng(0).random((8, 16, 3)).astype(np.float32)
    expected, found = asset.irradiance(light), [None] * 8

    def relight(i):
        found[i] = asset.irradiance(light)

    workers = [threading.Thread(target=relight, args=(i,)) for i in range(len(found))]
    for worker in workers:
        worker.start()
    for worker in workers:
        worker.join()
    for irradiance in found:
        np.testing.assert_array_equal(irradiance, expected)
    assert set(blas_threads()) == {2}


# --- memory ---------------------------------------------------------------------------------------


def test_a_share_that_cannot_be_held_is_refused_before_the_rays(monkeypatch, tmp_path):
    """Of the share of the variance a few points tell how many coefficients it takes at least; what
    many components take fits or not.
    """
    traced = []
    opened = open_scene(scene(a=rectangle(), b=cube((0, 0.5, 0), 0.3)))
    plan = make_plan(opened, SETTINGS | {"coefficients": "auto", "variance": 0.9})
    _, (builder,) = begin(opened, plan, lambda *_: None, 1 << 33)
    count = distant_pilot.expected_components(builder.job, builder._directions, builder._target)
    assert 2 <= count < 64

    class Room:
        channels = 1

        def __init__(self, coefficients):
            self.basis = distant_pilot.held_coefficient_bytes(
                builder.job.settings, len(builder.job.points), 384, coefficients, 1
            )

    arguments = builder.job, builder._directions, builder._target
    distant_pilot.check_share(*arguments, Room(distant_pilot.MANY))  # nothing is said
    with pytest.warns(UserWarning, match=rf"holds {2 * count}: the run may end after its rays"):
        distant_pilot.check_share(*arguments, Room(2 * count))
    with pytest.raises(SettingsError, match=rf"variance 0.9 takes about {count} coefficients"):
        distant_pilot.check_share(*arguments, Room(count - 1))

    # the same within a run
    monkeypatch.setattr(distant_pilot, "MANY", 1 << 30)
    huge = lambda *_: 1 << 50
    monkeypatch.setattr(distant_pilot, "held_coefficient_bytes", huge)
    with pytest.raises(SettingsError, match="--max-memory"):
        mi_prt.precompute(
            opened.mi_scene,
            progress=lambda *event: traced.append(event),
            **SETTINGS | {"coefficients": "auto", "variance": 0.9},
        )
    assert not traced


def test_parts_of_a_fit_are_bounded_on_many_cores(monkeypatch):
    """What a fit takes grows by the sums of its threads, and no further than there are parts."""
    sizes = []
    for threads in (2, 8, 16, 256):
        monkeypatch.setattr(pca, "thread_count", lambda count=threads: count)
        sizes.append(pca.fit_bytes(100_000, 6144, 64))
    assert sizes[0] < sizes[1] < sizes[2] == sizes[3]
    assert sizes[0] == 110 * 6144 * 80


# --- what info says -------------------------------------------------------------------------------


def test_reflections_in_a_room_beside_many_small_points():
    """A box that is open to one side, and outside of it a mesh of as many points that see nothing
    but sky and are next to nothing of the surface, and one large plane far away: each point of the
    probe counts for what it stands for.
    """
    walls = {
        f"wall{i}": rectangle(n, [-x for x in n], 1)
        for i, n in enumerate([(0, 1, 0), (0, -1, 0), (1, 0, 0), (-1, 0, 0), (0, 0, 1)])
    }
    tiny = {f"tiny{i}": cube((0, 3 + i, 0), 0.01) for i in range(3)}
    opened = open_scene(scene(**walls, **tiny))
    plan = make_plan(opened, {"directions": "cubemap:8", "edge_length": 0.5})
    job, (builder,) = begin(opened, plan, lambda *_: None, 1 << 33)
    index = distant_forecast._by_area(job.points.areas, 0)
    large = job.points.areas[index] > 1e-3
    assert large.mean() > 0.95 and len(index) == min(256, len(job.points))
    forecast = builder.forecast()
    energy = forecast["requires"]["bounce_energy"]
    asset = mi_prt.precompute(opened.mi_scene, directions="cubemap:8", edge_length=0.5)
    found = asset.transports["distant"].report["bounce_energy"]
    assert energy[0] == pytest.approx(found[0], rel=0.1)
    assert energy[1] == pytest.approx(found[1], rel=0.2)
    assert "0.1 % of the light is left" in forecast["reasons"]["bounces"]
    assert Settings(**asset.settings).distant_bounces == "auto"
