"""Background thread that runs only the latest submitted job."""

import threading

from idle_worker import idle

from lang3dxl_ns.common.worker import Worker


def raised(error: Exception) -> None:
    raise error


def test_the_last_of_several_waiting_jobs_is_done():
    done, worker = [], Worker("test", raised)
    for i in range(5):
        worker.submit(lambda i=i: done.append(i), delay=0.05)
    assert idle(worker, 5)
    assert done == [4]


def test_a_job_under_way_is_not_given_up():
    done, worker, begun, go_on = [], Worker("test", raised), threading.Event(), threading.Event()

    def slow():
        begun.set()
        go_on.wait(5)
        done.append("slow")

    worker.submit(slow)
    assert begun.wait(5)
    worker.submit(lambda: done.append("next"))
    assert not idle(worker, 0.05)
    go_on.set()
    assert idle(worker, 5)
    assert done == ["slow", "next"]


def test_a_failed_job_is_reported_and_the_next_one_done():
    done, worker = [], Worker("test", lambda error: done.append(str(error)))
    worker.submit(lambda: int("seven"))
    assert idle(worker, 5)
    worker.submit(lambda: done.append("next"))
    assert idle(worker, 5)
    assert "seven" in done[0] and done[1] == "next"
