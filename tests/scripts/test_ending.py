"""Scripts end as the commands do."""

from __future__ import annotations

import pytest
from ending import documented_ending

from modp_ti.files.errors import InputError


class RefusalError(Exception):
    pass


@pytest.mark.parametrize(
    ("error", "code", "said"),
    [
        (InputError("scene.yaml: is\nwrong"), 2, "error: scene.yaml: is wrong\n"),
        (RefusalError("the door is shut"), 2, "error: the door is shut\n"),
        (KeyboardInterrupt(), 130, "error: interrupted\n"),
    ],
)
def test_what_is_no_fault_is_said_in_one_line(error: BaseException, code: int, said: str, capsys) -> None:
    with pytest.raises(SystemExit) as ended, documented_ending(RefusalError):
        raise error
    assert ended.value.code == code
    assert capsys.readouterr().err == said


def test_a_fault_shows_where_it_happened(capsys) -> None:
    @documented_ending()
    def faulty() -> None:
        raise ZeroDivisionError("nothing to share")

    with pytest.raises(SystemExit) as ended:
        faulty()
    assert ended.value.code == 3
    lines = capsys.readouterr().err.splitlines()
    assert lines[0].startswith("Traceback") and "please report it" in lines[-1]


def test_what_ends_well_goes_on() -> None:
    with documented_ending():
        pass
