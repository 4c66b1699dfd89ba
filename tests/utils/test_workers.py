"""utils/workers.py: results in the order of the jobs."""

import itertools
import math
import threading

import numpy as np
import pytest

from roboarm_nmp.utils import workers


@pytest.mark.parametrize("processes", [0, 2])
def test_results_come_in_the_order_of_the_jobs(processes):
    sizes = [20_000, 3, 10_000, 2, 5, 1]  # the first takes longest
    results = list(workers.in_order(math.factorial, sizes, processes))
    assert results == [math.factorial(size) for size in sizes]


def test_endless_jobs_end_when_they_are_closed_and_errors_are_raised():
    results = workers.in_order(math.sqrt, itertools.count(), 1)
    assert [next(results) for _ in range(4)] == [0.0, 1.0, math.sqrt(2), math.sqrt(3)]
    results.close()
    results = workers.in_order(math.sqrt, [4, -1], 1)
    assert next(results) == 2.0
    with pytest.raises(ValueError):
        next(results)


def large(number):
    return np.zeros(4_000_000)


def test_results_that_are_being_sent_do_not_delay_the_end():
    results = workers.in_order(large, itertools.count(), 2)
    next(results)
    ended = threading.Thread(target=results.close, daemon=True)
    ended.start()
    ended.join(30)
    assert not ended.is_alive()
