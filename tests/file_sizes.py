"""A limit to the size of files, in place of a disk that is full."""

import os
import resource
import sys
from contextlib import contextmanager
from unittest.mock import patch


@contextmanager
def files_of_at_most(size_bytes):
    """Within, no file of this process grows beyond that, nor one of a process that begins then.

    Python would leave compiled modules behind that end in the middle, and fail at every later import of them: it is
    told to write none.
    """
    before = resource.getrlimit(resource.RLIMIT_FSIZE)
    with patch.object(sys, "dont_write_bytecode", True), patch.dict(os.environ, {"PYTHONDONTWRITEBYTECODE": "1"}):
        resource.setrlimit(resource.RLIMIT_FSIZE, (size_bytes, before[1]))
        try:
            yield
        finally:
            resource.setrlimit(resource.RLIMIT_FSIZE, before)
