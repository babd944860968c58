"""A library that cannot be imported is an error of this package that says what to install."""

import pytest

from mwdn.errors import MissingPackageError
from mwdn.runtime.requirement import require


@pytest.mark.parametrize("error", ["ImportError", "ValueError", "RuntimeError"])
def test_a_library_that_fails_is_named_with_its_reason(error, tmp_path, monkeypatch):
    """RuntimeError: deepinv imports torchvision, which raises it if it was built for another torch."""
    (tmp_path / "broken_library.py").write_text(f"raise {error}('operator torchvision::nms does not exist')")
    monkeypatch.syspath_prepend(tmp_path)
    with pytest.raises(MissingPackageError, match=r"broken_library \(.*torchvision::nms.*mwdn\[deepinverse\]"):
        require("broken_library", "deepinverse")
