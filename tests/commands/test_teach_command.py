"""`lang3dxl teach`, `lang3dxl words` and `lang3dxl query --coco`, on a scene file."""

import json
import shlex
import time
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from threading import Event

import numpy as np
import pytest
import torch
from painted_scene import CHANNELS, encode_texts, painted_file, painted_scene
from PIL import Image

from lab.baselines.lifting import LiftedFeatures
from lang3dxl_ns.cli import main
from lang3dxl_ns.commands.export import Export
from lang3dxl_ns.commands.teach import Teach, forgotten
from lang3dxl_ns.common.errors import UserError
from lang3dxl_ns.files.coco import CocoLabels
from lang3dxl_ns.files.scene_file import (
    Provenance,
    describe_scene_file,
    keep_words,
    read_scene,
    replace_scene,
    write_scene,
)
from lang3dxl_ns.open_scene import find_scene_file
from lang3dxl_ns.words.taught_words import load_words, mask_of, run_lengths

DOME = "61,61,77,77"
"""Box of the dome in all/0003.jpg, a little large."""


@pytest.fixture
def place(tmp_path, monkeypatch):
    """A scene file, whose CLIP is the painted one."""
    monkeypatch.setattr("lang3dxl_ns.query.answering.text_encoder", lambda file, device: encode_texts)
    decoder = LiftedFeatures(CHANNELS, 0)
    decoder.name = "lifting"
    painted = painted_scene()
    codes = torch.cat([torch.nan_to_num(painted.codes), torch.ones(len(painted.codes), 1)], 1)
    file = replace(painted_file(), data="wall")
    write_scene(tmp_path / "wall.scene", painted_scene(decoder=decoder, codes=codes, file=file))
    return tmp_path / "wall.scene"


def teach(place, *flags):
    main(["teach", str(place), "--word", "gizmo", "--photo", "0003.jpg", *flags])


def words(place):
    return read_scene(place, "cpu").words


def test_a_word_is_kept_in_the_scene_and_nothing_else_changes(place, capsys):
    before = read_scene(place, "cpu")
    teach(place, "--box", DOME)
    after = read_scene(place, "cpu")
    assert torch.equal(before.splats.harmonics, after.splats.harmonics)
    assert torch.equal(before.codes, after.codes) and after.file == before.file
    assert after.words["gizmo"].examples[0].box == tuple(map(float, DOME.split(",")))
    said = capsys.readouterr().out
    assert "1 example" in said and "average precision" in said and "check it" in said
    teach(place, "--box", DOME)  # a command that is repeated, such as one that was killed, adds nothing
    assert len(words(place)["gizmo"].examples) == 1
    teach(place, "--at", "69,69", "--not-at", "20,60")
    assert len(words(place)["gizmo"].examples) == 2
    main(["words", str(place), "--forget", "gizmo/1"])
    (left,) = words(place)["gizmo"].examples
    assert left.points == ((69, 69),) and left.not_points == ((20, 60),)
    main(["words", str(place), "--forget", "Gizmo"])
    assert not words(place)


def test_a_word_of_another_width_is_refused_by_scenes_and_their_files(place):
    teach(place, "--box", DOME)
    scene = read_scene(place, "cpu")
    wide = replace(scene.words["gizmo"], vector=torch.ones(5), examples=())
    with pytest.raises(UserError, match="a CLIP other than"):
        scene.carrying(wide)
    keep_words(place, {"gizmo": wide})
    with pytest.raises(UserError, match=r"wall\.scene.*another CLIP"):
        read_scene(place, "cpu")


def test_a_word_that_is_taught_while_another_is_forgotten_stays(place, monkeypatch):
    teach(place, "--box", DOME)

    def meanwhile(scene, name):
        found = forgotten(scene, name)
        main(["teach", str(place), "--word", "widget", "--photo", "0003.jpg", "--at", "69,69"])
        return found

    monkeypatch.setattr("lang3dxl_ns.commands.teach.forgotten", meanwhile)
    main(["words", str(place), "--forget", "gizmo"])
    assert list(words(place)) == ["widget"]


def test_a_word_that_is_taught_twice_at_once_has_both_examples(place, monkeypatch):
    monkeypatch.setattr(
        "lang3dxl_ns.files.scene_file.keep_words", lambda *given: time.sleep(0.5) or keep_words(*given)
    )
    two = [Teach(scene=place, word="gizmo", photo="0003.jpg", at=[at]) for at in ("69,69", "70,70")]
    with ThreadPoolExecutor() as both:
        list(both.map(Teach.main, two))
    assert len(words(place)["gizmo"].examples) == 2


def test_an_example_that_is_taught_while_its_word_is_forgotten_stays(place, monkeypatch):
    teach(place, "--box", DOME)

    def meanwhile(scene, name):
        teach(place, "--at", "69,69")
        return forgotten(scene, name)

    monkeypatch.setattr("lang3dxl_ns.commands.teach.forgotten", meanwhile)
    with pytest.raises(SystemExit, match="'gizmo' was taught at this moment: repeat"):
        main(["words", str(place), "--forget", "gizmo/1"])
    assert len(words(place)["gizmo"].examples) == 2


@pytest.mark.parametrize("which", [["gizmo/1", "gizmo/2"], ["Gizmo/2", "gizmo/1", "gizmo/1"]])
def test_numbers_of_examples_are_those_of_the_list_however_many_are_forgotten(place, which):
    for at in ("69,69", "70,70", "71,71"):
        teach(place, "--at", at)
    main(["words", str(place), *(word for name in which for word in ("--forget", name))])
    (left,) = words(place)["gizmo"].examples
    assert left.points == ((71, 71),)


def test_a_negative_of_no_text_is_told(place, tmp_path):
    with pytest.raises(SystemExit, match="--not is a negative of texts"):
        main(["export", str(place), "--not", "window", "--out", str(tmp_path / "a.ply")])


def test_words_are_not_saved_over_a_scene(place):
    teach(place, "--box", DOME)
    with pytest.raises(SystemExit, match=r"wall\.scene is not the name of a \.json file"):
        main(["words", str(place), "--save", str(place)])
    assert words(place)


@pytest.mark.parametrize("white", [255, 1])
def test_a_mask_teaches_and_queries_say_so(place, tmp_path, capsys, white):
    mask = np.zeros((96, 96), np.uint8)
    mask[62:76, 62:76] = white
    Image.fromarray(mask).save(tmp_path / "m.png")
    teach(place, "--mask", str(tmp_path / "m.png"))
    out = tmp_path / "found"
    labels = tmp_path / "labels.json"
    main(["query", str(place), "--text", "gizmo", "--all", "--out", str(out), "--coco", str(labels)])
    assert "(taught)" in capsys.readouterr().out
    report = json.loads((out / "query.json").read_text())
    assert report["texts"][0]["taught"]
    told = json.loads(labels.read_text())
    assert len(told["images"]) == 4 and told["categories"] == [{"id": 1, "name": "gizmo"}]
    parts = [
        a for a in told["annotations"] if told["images"][a["image_id"] - 1]["file_name"] == "all/0003.jpg"
    ]
    part = max(parts, key=lambda each: each["area"])  # an annotation for every connected part
    shown = mask_of(part["segmentation"]["counts"], tuple(part["segmentation"]["size"]))
    assert (shown & (mask > 0)).sum() / (shown | (mask > 0)).sum() > 0.6
    assert part["area"] == shown.sum()
    plain = tmp_path / "plain"
    main(["query", str(place), "--text", "gizmo", "--image", "0003", "--out", str(plain), "--without-taught"])
    assert not json.loads((plain / "query.json").read_text())["texts"][0]["taught"]


def test_words_are_carried_to_another_scene(place, tmp_path, capsys):
    teach(place, "--box", DOME)
    kept = tmp_path / "words.json"
    main(["words", str(place), "--save", str(kept)])
    same, other, foreign = (tmp_path / f"{name}.scene" for name in ("same", "other", "foreign"))
    scene = read_scene(place, "cpu").with_words(())
    write_scene(same, scene)
    for path, change in ((other, {"data": "tower"}), (foreign, {"data": "tower", "clip_identity": "45"})):
        scene.file = replace(scene.file, **change)
        write_scene(path, scene)
    main(["words", str(same), "--load", str(kept)])
    assert words(same)["gizmo"].examples, "the same photos: learned anew"
    main(["words", str(other), "--load", str(kept)])
    assert "carried over from wall" in capsys.readouterr().out
    assert torch.equal(words(other)["gizmo"].vector, words(place)["gizmo"].vector)
    alike = tmp_path / "alike.json"  # another folder of this name, with other photos of the same names
    content = json.loads(kept.read_text())
    content["words"][0]["examples"][0]["size"][0] += 1
    alike.write_text(json.dumps(content))
    main(["words", str(same), "--forget", "gizmo", "--load", str(alike)])
    assert not words(same)["gizmo"].examples
    with pytest.raises(SystemExit, match="a CLIP other than"):
        main(["words", str(foreign), "--load", str(kept)])


def test_words_that_are_loaded_do_not_replace_examples_of_the_scene(place, tmp_path):
    teach(place, "--box", DOME)
    kept = tmp_path / "words.json"
    main(["words", str(place), "--save", str(kept)])
    kept.write_text(kept.read_text().replace('"wall"', '"tower"'))
    with pytest.raises(SystemExit, match="'gizmo' was taught here by examples, which would be lost"):
        main(["words", str(place), "--load", str(kept)])
    assert words(place)["gizmo"].examples
    main(["words", str(place), "--forget", "gizmo", "--load", str(kept)])
    assert not words(place)["gizmo"].examples


@pytest.mark.parametrize(
    ("change", "said"),
    [
        ({}, "'gizmo' is kept, learned anew from its examples (1)"),
        ({"data": "tower"}, "'gizmo' is kept, as it was"),
        (
            {"data": "tower", "clip_identity": "45"},
            "'gizmo' is lost: 'gizmo' was learned with a CLIP other than",
        ),
    ],
)
def test_a_scene_written_over_another_keeps_its_words_and_says_so(place, tmp_path, capsys, change, said):
    scene = read_scene(place, "cpu")
    new = painted_scene(
        splats=scene.splats, codes=scene.codes, decoder=scene.decoder, file=replace(scene.file, **change)
    )
    write_scene(tmp_path / "new.scene", new)
    teach(place, "--box", DOME)
    before = words(place)["gizmo"]
    main(["export", str(tmp_path / "new.scene"), "--scene-file", str(place)])
    assert said in capsys.readouterr().out.replace("\n", " ")
    after = words(place).get("gizmo")
    if "lost" in said:
        assert after is None
    else:
        assert torch.allclose(after.vector, before.vector, atol=1e-5)
        assert len(after.examples) == (not change)


def test_a_word_that_is_taught_while_its_scene_is_written_over_stays(place, tmp_path, monkeypatch):
    write_scene(tmp_path / "new.scene", read_scene(place, "cpu"))
    main(["teach", str(place), "--word", "widget", "--photo", "0003.jpg", "--box", DOME])
    export = Export(scene=tmp_path / "new.scene", scene_file=place)
    begun, taught = Event(), Event()

    def slowly(*given):
        begun.set()
        taught.wait(1.5)  # in vain, since the other command waits for this one
        return write_scene(*given)

    monkeypatch.setattr("lang3dxl_ns.files.scene_file.write_scene", slowly)
    with ThreadPoolExecutor() as both:
        writing = both.submit(export.main)
        begun.wait()
        teach(place, "--box", DOME)
        taught.set()
        writing.result()
    assert words(place).keys() == {"gizmo", "widget"}


def test_another_name_than_a_scenes_is_refused_before_a_folder_is_made(place, tmp_path):
    with pytest.raises(SystemExit, match=r"a\.ply must have the extension"):
        main(["export", str(place), "--scene-file", str(tmp_path / "new" / "a.ply")])
    assert not (tmp_path / "new").exists()


def test_the_next_command_can_be_pasted_whatever_the_name(place, tmp_path, capsys):
    name = tmp_path / "my scene" / "it's.scene"
    main(["export", str(place), "--scene-file", str(name)])
    told = capsys.readouterr().out.replace("\n", "").partition("lang3dxl query ")[2]
    assert shlex.split(told) == [str(name)]


def test_a_scenes_own_words_win_and_a_damaged_file_is_set_aside(place, tmp_path, capsys):
    other = tmp_path / "other.scene"
    write_scene(other, read_scene(place, "cpu"))
    teach(other, "--at", "69,69")
    teach(place, "--box", DOME)
    main(["export", str(place), "--scene-file", str(other)])
    assert words(other)["gizmo"].examples[0].box is not None
    other.write_bytes(b"nonsense")
    main(["export", str(place), "--scene-file", str(other)])
    assert "The file is kept as" in capsys.readouterr().out and words(other)["gizmo"].examples
    assert b"nonsense" in [path.read_bytes() for path in other.parent.iterdir() if path != other]


@pytest.mark.parametrize(
    ("flags", "message"),
    [
        (["--box", "1,2,3"], "4 numbers"),
        (["--at", "a,b"], "2 numbers"),
        (["--at", "nan,2"], "not a number"),
        ([], "nothing is marked"),
        (["--mask", "nowhere.png"], "can't be read"),
    ],
)
def test_wrong_marks_are_one_sentence_and_leave_the_file(place, flags, message):
    before = place.read_bytes()
    with pytest.raises(SystemExit, match=message):
        teach(place, *flags)
    assert place.read_bytes() == before


def test_a_word_with_a_slash_and_a_number_can_be_forgotten(place):
    main(["teach", str(place), "--word", "doors/2", "--photo", "0003.jpg", "--box", DOME])
    main(["words", str(place), "--forget", "doors/2"])
    assert not words(place)


@pytest.mark.parametrize("name", ['"a" not "b"', "“dome”", " ; ", "dome " * 9999])
def test_a_name_that_no_prompt_means_is_refused_before_anything_is_written(place, name):
    before = place.read_bytes()
    with pytest.raises(SystemExit, match=r"no prompt means|the prompt is empty|letters"):
        main(["teach", str(place), "--word", name, "--photo", "0003.jpg", "--box", DOME])
    assert place.read_bytes() == before


def test_clicks_have_no_average_precision(place, capsys):
    teach(place, "--at", "69,69", "--at", "68,70")
    said = capsys.readouterr().out
    assert "2 points in" in said and "average precision" not in said


def test_run_lengths_return_the_mask():
    generator = np.random.default_rng(0)
    for size in ((1, 1), (3, 5), (7, 2)):
        for mask in (generator.random(size) < 0.4, np.ones(size, bool), np.zeros(size, bool)):
            assert np.array_equal(mask_of(run_lengths(mask), size), mask)
    column_first = np.array([[False, True], [True, True]])
    assert run_lengths(column_first) == [1, 3]
    assert run_lengths(np.array([[True, False]])) == [0, 1, 1]
    with pytest.raises(ValueError, match="run lengths"):
        mask_of([1, 2], (2, 2))


def test_every_connected_part_is_an_annotation():
    mask = np.zeros((40, 60), bool)
    mask[5:10, 10:20] = mask[30:35, 40:42] = True
    labels = CocoLabels(["a", "b"])
    labels.add("x.jpg", [np.zeros_like(mask), mask])
    first, second = labels.content["annotations"]
    assert first["bbox"] == [10, 5, 10, 5] and second["bbox"] == [40, 30, 2, 5]
    assert first["category_id"] == 2 and first["area"] == 50
    assert labels.content["images"] == [{"id": 1, "file_name": "x.jpg", "width": 60, "height": 40}]


def test_loaded_words_keep_the_examples_that_only_the_scene_has(place, tmp_path):
    """As an older copy of its own words lacks the newer ones."""
    teach(place, "--box", DOME)
    main(["words", str(place), "--save", str(tmp_path / "words.json")])
    main(["words", str(place), "--load", str(tmp_path / "words.json")])
    teach(place, "--at", "69,69")
    with pytest.raises(SystemExit, match="'gizmo' was taught here by examples, which would be lost"):
        main(["words", str(place), "--load", str(tmp_path / "words.json")])
    assert len(words(place)["gizmo"].examples) == 2


def retrained(place, path, *gone):
    """Write a scene of the same photos but some, without words."""
    scene = read_scene(place, "cpu").with_words(())
    photos = [photo for photo in scene.file.photos if photo.name not in gone]
    scene.file = replace(scene.file, photos=photos)
    write_scene(path, scene)


def test_a_word_keeps_the_examples_whose_photos_are_left(place, tmp_path, capsys):
    teach(place, "--box", DOME)
    teach(place, "--at", "69,69")
    photo = next(
        p.name for p in read_scene(place, "cpu").photos if p.split == "train" and "0003" not in p.name
    )
    main(["teach", str(place), "--word", "gizmo", "--photo", photo, "--at", "69,69"])
    retrained(place, tmp_path / "new.scene", photo)
    main(["export", str(tmp_path / "new.scene"), "--scene-file", str(place)])
    assert len(words(place)["gizmo"].examples) == 2
    said = " ".join(capsys.readouterr().out.split())
    assert "learned anew from its examples (2); the photos of 1 others are not those of before" in said


def test_a_word_that_a_new_scene_brings_leaves_the_earlier_examples_in_a_file(place, tmp_path, capsys):
    teach(place, "--box", DOME)
    write_scene(tmp_path / "new.scene", read_scene(place, "cpu"))
    teach(place, "--at", "69,69")
    main(["export", str(tmp_path / "new.scene"), "--scene-file", str(place)])
    assert len(words(place)["gizmo"].examples) == 1
    kept = place.with_name("wall.gizmo.json")
    assert str(kept) in capsys.readouterr().out.replace("\n", "")
    (word,) = load_words(kept)
    assert len(word.examples) == 2


def test_a_scene_written_over_another_keeps_its_credit_and_license(place, tmp_path):
    told = Provenance("Wall", "photos by A", "CC BY", made_how="by hand")
    write_scene(place, read_scene(place, "cpu"), told)
    replace_scene(place, read_scene(place, "cpu"), Provenance("New", license="CC0"))
    found = describe_scene_file(place)["provenance"]
    assert (found.title, found.credit, found.license) == ("New", "photos by A", "CC0")


def test_teach_takes_the_clip_from_another_place(place, monkeypatch):
    """Where the scene file's is not on this machine."""
    asked = []
    monkeypatch.setattr(
        "lang3dxl_ns.open_scene.text_encoder", lambda file, device: asked.append(file.clip) or encode_texts
    )
    teach(place, "--box", DOME, "--clip", "elsewhere")
    main(["words", str(place), "--clip", "elsewhere"])
    assert asked == ["elsewhere", "elsewhere"] and words(place)


def test_the_runs_of_a_part_are_those_of_the_whole_mask():
    generator = np.random.default_rng(0)
    mask = generator.random((23, 31)) < 0.4
    mask[0, 0] = mask[-1, -1] = True
    labels = CocoLabels(["x"])
    labels.add("a.jpg", [mask])
    whole = np.zeros_like(mask)
    for found in labels.content["annotations"]:
        part = mask_of(found["segmentation"]["counts"], (23, 31))
        assert found["segmentation"]["counts"] == run_lengths(part) and part.sum() == found["area"]
        assert not (part & whole).any()
        whole |= part
    assert not (whole & ~mask).any()
    assert (mask & ~whole).sum() < 0.5 * mask.sum()


def test_hidden_files_beside_a_scene_are_no_scenes(place):
    """macOS leaves one beside each file on disks of other systems."""
    place.with_name("._wall.scene").write_bytes(b"\0\5\x16\7")
    assert find_scene_file(place.parent) == place
    with pytest.raises(SystemExit, match=r"wall\.scene is scored with --ground-truth"):
        main(["evaluate", "run", str(place.parent), "--out", str(place.parent / "report")])
