"""Settings of the allocator, in a separate process so that other tests keep their settings."""

import sys

import pytest

from tests.processes import printed_by

SCRIPT = """
import resource, torch
from nerfro.kernels.available import keep_freed_memory

def faults():
    before = resource.getrusage(resource.RUSAGE_SELF).ru_minflt
    for _ in range(20):
        torch.zeros(8, 2**20)  # 32 MiB, 8192 pages
    return resource.getrusage(resource.RUSAGE_SELF).ru_minflt - before

torch.set_num_threads(1)
print(keep_freed_memory())
faults()
print(faults())
"""


@pytest.mark.skipif(not sys.platform.startswith("linux"), reason="a setting of Linux's C library")
def test_repeated_tensors_reuse_memory_without_page_faults() -> None:
    accepted, faults = printed_by("-c", SCRIPT).split()
    if accepted != "True":
        pytest.skip("the C library is not glibc")
    assert int(faults) < 20 * 8192 / 10
