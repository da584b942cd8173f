import pytest

from ultragray.errors import InvalidArgument
from ultragray_workers.jobs.kinds import TrainJob, train
from ultragray_workers.jobs.kinds.base import Surroundings


@pytest.mark.long
def test_a_training_may_not_have_more_memory_than_the_host(tmp_path, monkeypatch):
    monkeypatch.setattr(train, "memory_bytes", lambda: 8 << 30)

    def check(device, memory_gb):
        TrainJob("liver", "new", settings={"memory_gb": memory_gb}, device=device).check(
            Surroundings(None, tmp_path, 512)
        )

    for device in ("cpu", "auto"):
        with pytest.raises(
            InvalidArgument, match=r"memory_gb must be at most the 8\.0 GiB of the host, got 8\.5"
        ) as told:
            check(device, 8.5)
        assert told.value.field == "settings.memory_gb"
        check(device, 8.0)
        check(device, None)
    check("cuda:0", 80.0)  # of the GPU, which the worker knows
