"""`lang3dxl things` answers as it was asked, and tells which part of a question it did not use."""

import csv
import json

import pytest
from painted_scene import painted_scene

from lang3dxl_ns.commands.evaluate import EvaluateThings
from lang3dxl_ns.commands.things import ListThings
from lang3dxl_ns.common.errors import UserError
from lang3dxl_ns.words.taught_words import Example


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
    assert left.startswith("leftmost window: 1 found: id ") and " in " in left and ".jpg" in left


def test_what_an_answer_does_not_use_is_told(ask):
    assert "red is likely to be ignored" in " ".join(ask(text=["red windows"]))
    assert "counting" not in " ".join(ask(text=["how many windows"]))
    with pytest.raises(UserError, match="near"):
        ask("windows near the dome")


def test_a_word_is_asked_for_too(ask):
    *_, found = ask("is there a dome?")
    assert found.startswith("is there a dome?: 1 found: id ")


def test_a_question_without_an_answer_does_not_end_those_that_have_one(ask, tmp_path):
    *_, count, near, gate = ask(
        "how many windows", "windows near the dome", "windows above the gate", out=tmp_path
    )
    assert count == f"Wrote the things to {tmp_path}" and (tmp_path / "things.json").exists()
    assert near.startswith("windows near the dome: a question can't use near")
    assert gate.startswith("windows above the gate: no gate found, ")
    assert "windows above the gate" in ask("windows above the gate", text=["windows"])[-1]
    with pytest.raises(UserError, match="no gate found"):
        ask("windows above the gate")


@pytest.mark.parametrize("name", ["things.json", "instances.json"])
def test_what_a_person_drew_is_not_replaced(monkeypatch, tmp_path, name):
    monkeypatch.setattr("lang3dxl_ns.open_scene.load_scene", lambda *which, **how: pytest.fail("loaded"))
    drawn = '{"info": {"description": "by hand"}, "images": [], "annotations": []}'
    (tmp_path / name).write_text(drawn)
    with pytest.raises(UserError, match=rf"{name} would be replaced"):
        ListThings(text=["windows"], out=tmp_path).main()
    assert [path.read_text() for path in tmp_path.iterdir()] == [drawn]


def test_a_call_replaces_the_files_of_an_earlier_one_and_names_what_it_leaves(ask, tmp_path):
    ask(text=["windows"], out=tmp_path, splats=True)
    files = {path: path.read_bytes() for path in tmp_path.iterdir() if path.is_file()}
    old = {path.name for path in (tmp_path / "splats").glob("*.ply")}
    EvaluateThings(coco=tmp_path / "instances.json", out=tmp_path).main()
    assert len(files) == 4 and all(path.read_bytes() == content for path, content in files.items())
    told = ask(text=["flamingo"], out=tmp_path)[-1]
    assert "has files that are not of this call" in told and all(name in told for name in old)
    assert not any(path.read_bytes() == content for path, content in files.items())
    assert "not of this call" not in " ".join(ask(text=["windows"], out=tmp_path, splats=True))


def test_a_word_with_negatives_is_not_the_word_alone(ask, tmp_path):
    texts = ['"windows" not "window"', "windows not domes"]
    assert ask("how many windows", text=texts, out=tmp_path, splats=True)[0].startswith(
        texts[0].replace('"', "")
    )
    catalog = json.loads((tmp_path / "things.json").read_text())
    counts = {"windows not window": 0, "windows not domes": 2, "windows": 2}
    assert {one["word"]: one["count"] for one in catalog["words"]} == counts
    assert {one["word"] for one in catalog["things"]} == {"windows not domes"}  # each thing once
    assert len([*(tmp_path / "splats").glob("windows-not-domes-*.ply")]) == 2


def test_quotes_and_taught_names_hold_a_phrase(ask, monkeypatch):
    assert ask('how many "windows on the dome"')[-1].startswith('how many "windows on the dome": ')
    scene = painted_scene()
    taught = scene.teach("Hole in the wall", Example(scene.photos[0].name, points=((48.0, 48.0),)))
    monkeypatch.setattr("lang3dxl_ns.open_scene.load_scene", lambda *which, **how: taught)
    *_, word, told = ask("how many hole in the wall")
    assert word.startswith("hole in the wall: ") and told.startswith("how many hole in the wall: ")


def test_texts_with_several_prompts_are_asked_along_with_questions(ask):
    lines = ask("how many windows", text=["dome; windows"])
    counts = [line for line in lines if line.startswith(("dome: ", "windows: ", "how many windows: "))]
    assert len(counts) == 3 and counts[-1].startswith("how many windows: 2")


def test_left_is_told_within_the_photo_that_one_names(ask):
    name = painted_scene().photos[0].name
    assert "1 found: id " in ask("leftmost window", view=name)[-1]
    with pytest.raises(UserError, match="only 2 found in this view"):
        ask("third window from the left", view=name)


def test_one_table_is_printed_and_written_and_labels_have_one_category_for_a_word(ask, tmp_path):
    lines = ask("leftmost window", text=["windows", "dome"], out=tmp_path)
    start = next(i for i, line in enumerate(lines) if line.startswith("number"))
    with (tmp_path / "things.csv").open() as file:
        rows = list(csv.DictReader(file))
    catalog = json.loads((tmp_path / "things.json").read_text())
    for row, line, told in zip(rows, lines[start + 1 :], catalog["things"], strict=False):
        assert line.split()[:3] == [row["number"], row["word"], row["id"]]
        assert line.split()[-2:] == [f"{float(row['score']):.2f}", row["photo"]]
        assert [told[name] for name in ("number", "word", "id")] == [
            int(row["number"]),
            row["word"],
            int(row["id"]),
        ]
        assert told["photos"][0]["photo"] == row["photo"]
    assert [[row["word"], row["number"]] for row in rows] == [
        ["windows", "1"],
        ["windows", "2"],
        ["dome", "1"],
    ]
    labels = json.loads((tmp_path / "instances.json").read_text())
    assert [one["name"] for one in labels["categories"]] == ["windows", "dome"]
    pairs = [(one["image_id"], one["thing"]) for one in labels["annotations"]]
    assert len(pairs) == len(set(pairs)) > len(rows)
