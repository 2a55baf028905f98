"""Quick starts of the processes that prepare."""

import pytest
from processes import SERVER


@pytest.fixture
def forked_workers(monkeypatch) -> None:
    """Workers begin with the libraries loaded, which they would import for ten seconds each. The test of one
    that is killed has a true start."""
    monkeypatch.setattr("lang3dxl_ns.preparation.workers.get_context", lambda _: SERVER)
