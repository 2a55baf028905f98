"""Background thread that runs only the latest submitted job."""

import threading

from lang3dxl_ns.common.worker import Worker


def test_the_last_of_several_waiting_jobs_is_done():
    done, worker = [], Worker("test")
    for i in range(5):
        worker.submit(lambda i=i: done.append(i), delay=0.05)
    assert worker.wait(5)
    assert done == [4]


def test_a_job_under_way_is_not_given_up():
    done, worker, begun, go_on = [], Worker("test"), threading.Event(), threading.Event()

    def slow():
        begun.set()
        go_on.wait(5)
        done.append("slow")

    worker.submit(slow)
    assert begun.wait(5)
    worker.submit(lambda: done.append("next"))
    assert not worker.wait(0.05)
    go_on.set()
    assert worker.wait(5)
    assert done == ["slow", "next"]
