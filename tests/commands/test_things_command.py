"""`lang3dxl things` answers as it was asked, and tells which part of a question it did not use."""

import pytest
from painted_scene import painted_scene

from lang3dxl_ns.commands.things import ListThings
from lang3dxl_ns.common.errors import UserError


@pytest.fixture
def ask(monkeypatch, capsys):
    """Answers questions about the painted scene: two windows in a wall, and a dome."""
    monkeypatch.setattr("lang3dxl_ns.open_scene.load_scene", lambda *which, **how: painted_scene())

    def asked(*questions: str, **more) -> list[str]:
        ListThings(ask=list(questions), **more).main()
        return capsys.readouterr().out.splitlines()

    return asked


def test_a_count_is_a_number_and_a_list_names_what_it_lists_and_where_it_is_seen(ask):
    *words, count, left = ask("How many windows are there?", "leftmost window")[-4:]
    assert [line.split(":")[0] for line in words] == ["windows", "window"]
    assert count.startswith("How many windows are there?: 2")
    assert left.startswith("leftmost window: 1: ") and " in " in left and ".jpg" in left


def test_what_an_answer_does_not_use_is_told(ask):
    assert "red is likely to be ignored" in " ".join(ask(text=["red windows"]))
    with pytest.raises(UserError, match="near"):
        ask("windows near the dome")


def test_a_word_is_asked_for_too(ask):
    *_, found = ask("is there a dome?")
    assert found.startswith("is there a dome?: 1: ")
