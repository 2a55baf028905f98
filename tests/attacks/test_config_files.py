"""Hostile and damaged config.yml files and checkpoints, in our commands and in nerfstudio's."""

import contextlib
import math
import os
import shutil
import zipfile
from copy import deepcopy

import pytest
import torch
import yaml
from nerfstudio.configs.method_configs import all_methods

from lang3dxl_ns.cli import main
from lang3dxl_ns.common.errors import UserError
from lang3dxl_ns.components.downsampler import DownsamplerConfig
from lang3dxl_ns.methods import lang3dxl
from lang3dxl_ns.open_scene import load_scene
from lang3dxl_ns.plugin.run_checkpoint import read_checkpoint
from lang3dxl_ns.plugin.run_settings import TRUST_VARIABLE, check_command_line
from lang3dxl_ns.plugin.trainer_config import open_run, read_config
from lang3dxl_ns.scene import capture

TRAPS = [
    "!!python/object/apply:os.system ['touch {trap}']",
    '!!python/object/apply:builtins.eval [\'__import__("os").system("touch {trap}")\']',
    "!!python/object/apply:nerfstudio.utils.scripts.run_command ['touch {trap}']",
    "!!python/object/apply:nerfstudio.engine.trainer.Trainer ['touch {trap}']",
    "!!python/object/new:subprocess.Popen [['touch', '{trap}']]",
    "!!python/object/new:lang3dxl_ns.plugin.model.Lang3DXLModel []",
    "!!python/object/apply:builtins.getattr [!!python/name:nerfstudio.utils.writer.EventName '', mro]",
    "!!python/object/apply:builtins.getattr [!!python/name:nerfstudio.engine.trainer.Trainer '', train]",
    "!!python/name:os.system ''",
    "!!python/name:torch.hub.load ''",
    "!!python/module:antigravity ''",
    "!!python/object:collections.OrderedDict {{}}",
    "!!python/object:nerfstudio.data.dataparsers.minimal_dataparser.MinimalDataParserConfig {{}}",
    "!!python/name:nerfstudio.configs.dataparser_configs.MinimalDataParserConfig ''",
    "!<tag:yaml.org,2002:python/object/apply:os.system> ['touch {trap}']",
]


@pytest.fixture
def copy(two_steps, tmp_path):
    """A run folder to damage."""
    return shutil.copytree(two_steps.base_dir, tmp_path / "run")


def trapped(folder, text):
    """A config.yml with a trap among its settings, and the file that appears if the trap runs."""
    lines = yaml.dump(lang3dxl.config).splitlines()
    trap = text.format(trap=folder / "trap")
    model = next(i for i, line in enumerate(lines) if "model.Lang3DXLModelConfig" in line)
    indent = " " * (len(lines[model + 1]) - len(lines[model + 1].lstrip()))
    lines.insert(model + 1, f"{indent}rasterizer: {trap}")
    lines.insert(1, f"vis: {trap}")
    (folder / "config.yml").write_text("\n".join(lines))
    return folder / "config.yml", folder / "trap"


def test_members_of_enumerations_are_read_as_every_python_writes_them(copy):
    """Python 3.11.0 to 3.11.3, which Debian has, write them as attributes of their class."""
    path = copy / "config.yml"
    own = read_config(path).logging.local_writer.stats_to_track
    of = "!!python/name:nerfstudio.utils.writer.EventName ''"
    text = path.read_text()
    for event in own:
        for written in (f"EventName\n      - {event.value}\n", f"EventName\n      - '{event.value}'\n"):
            attribute = f"builtins.getattr\n      - {of}\n      - {event.name}\n"
            text = text.replace(f"nerfstudio.utils.writer.{written}", attribute)
    path.write_text(text)
    assert text.count("builtins.getattr") == len(own)
    assert read_config(path).logging.local_writer.stats_to_track == own


@pytest.mark.parametrize(
    ("text", "command"),
    [
        *((text, "query --text a") for text in TRAPS),
        *((TRAPS[0], command) for command in ("export --text a", "evaluate run", "view")),
    ],
)
def test_our_commands_run_nothing_in_a_config(tmp_path, text, command):
    path, trap = trapped(tmp_path, text)
    out = [] if command == "view" else ["--out", str(tmp_path / "out.ply")]
    with pytest.raises(SystemExit, match=r"Error: .*config\.yml can't be read"):
        main([*command.split(), str(path), *out])
    assert not trap.exists()


@pytest.mark.parametrize(
    ("text", "option"),
    [
        *((text, "--load-config {}") for text in TRAPS),
        *((TRAPS[0], option) for option in ("--load-config={}", "--load_config {}")),
    ],
)
def test_nerfstudios_commands_end_before_they_read_such_a_config(tmp_path, text, option):
    path, trap = trapped(tmp_path, text)
    with pytest.raises(SystemExit, match=r"config\.yml holds more than settings"):
        check_command_line(["ns-eval", *option.format(path).split()])
    assert not trap.exists()


def test_a_config_that_nests_too_deeply_for_the_check_is_refused(tmp_path):
    """nerfstudio reads it from fewer frames of the stack, where it may just fit."""
    path, _ = trapped(tmp_path, TRAPS[0])
    path.write_text(path.read_text() + f"\ndeep: {'[' * 5000}{']' * 5000}\n")
    with pytest.raises(SystemExit, match="more than settings"):
        check_command_line(["--load-config", str(path)])
    with pytest.raises(UserError, match=r"config\.yml can't be read"):
        read_config(path)


@pytest.mark.parametrize(
    ("setting", "other"),
    [
        ("lang3dxl_ns.plugin.dataparser.PhotoCollectionDataParser", "nerfstudio.data.dataparsers.X.Blender"),
        ("lang3dxl_ns.plugin.model.Lang3DXLModel", "nerfstudio.data.datasets.base_dataset.InputDataset"),
        ("lang3dxl_ns.plugin.pipeline.Lang3DXLPipeline", "nerfstudio.engine.trainer.Trainer"),
    ],
)
def test_settings_can_not_start_another_class_than_their_own(copy, setting, other):
    path = copy / "config.yml"
    text = path.read_text()
    assert setting in text
    other = other.replace("X.Blender", "blender_dataparser.Blender")
    path.write_text(text.replace(f"python/name:{setting} ", f"python/name:{other} "))
    with pytest.raises(UserError, match=r"would start .*_target"):
        open_run(path)
    if ".model" in setting:
        with pytest.raises(UserError, match=r"would start .*_target"):
            load_scene(path)
    else:  # queries take nothing but the model from the file
        assert len(load_scene(path).splats)


def test_a_config_whose_writer_is_trusted_passes(tmp_path, monkeypatch):
    path, _ = trapped(tmp_path, TRAPS[0])
    monkeypatch.setenv(TRUST_VARIABLE, "1")
    check_command_line(["--load-config", str(path)])


def test_the_trap_would_have_worked(tmp_path):
    path, trap = trapped(tmp_path, TRAPS[0])
    yaml.load(path.read_text(), Loader=yaml.Loader)
    assert trap.exists()


@pytest.mark.parametrize("method", sorted(all_methods))
def test_every_method_of_nerfstudio_passes(tmp_path, method):
    (tmp_path / "config.yml").write_text(yaml.dump(all_methods[method]))
    check_command_line(["--load-config", str(tmp_path / "config.yml"), "--load-config", "absent.yml"])
    check_command_line(["--load-config"])


def test_a_run_opens_without_nerfstudios_reader_wherever_it_lies(copy, monkeypatch):
    """And reads its photos' model once."""
    read, models = capture._of_model, []
    monkeypatch.setattr(capture, "_of_model", lambda *given: models.append(given[1]) or read(*given))
    config, pipeline, step = open_run(copy / "config.yml")
    assert step == 1 and config.get_base_dir() == copy and len(models) == 1
    assert pipeline.datamanager.get_datapath() == copy
    assert not pipeline.training


def test_a_run_with_an_unknown_setting_does_not_open(copy):
    path, decoder = copy / "config.yml", "!!python/object:lang3dxl_ns.components.decoders.DecoderConfig\n"
    text = path.read_text()
    indent = " " * (len(text.split(decoder)[1]) - len(text.split(decoder)[1].lstrip()))
    path.write_text(text.replace(decoder, f"{decoder}{indent}begin: noise\n"))
    with pytest.raises(UserError, match=r"unknown setting .*decoder\.begin"):
        open_run(path)


def cuts(text: str) -> list[int]:
    """Places to truncate a config: after some lines, and inside others."""
    ends = [i for i, c in enumerate(text) if c == "\n"]
    return [*ends[::23], *(end + 9 for end in ends[3::41])]


def test_a_config_that_is_cut_short_is_named_wherever_it_is_cut(copy):
    path = copy / "config.yml"
    text = path.read_text()
    whole = read_config(path)
    for cut in cuts(text):
        path.write_text(text[:cut])
        with contextlib.suppress(UserError):  # or what is missing took its default
            config = read_config(path)
            assert all(hasattr(config.pipeline.model, name) for name in vars(whole.pipeline.model))
            assert all(hasattr(config, name) for name in vars(whole))


def with_parameter(name, value):
    """A change of a checkpoint's state: one of the Gaussians' parameters has another value."""

    def change(state):
        (key,) = [k for k in state["pipeline"] if k.endswith(f"gauss_params.{name}")]
        state["pipeline"][key] = value
        return state

    return change


@pytest.mark.parametrize(
    ("change", "message"),
    [
        *(
            (lambda _, other=other: other, "checkpoint")
            for other in (
                {"step": 1, "pipeline": {}},
                {"step": 1, "pipeline": {"_model.field.weight": torch.ones(3)}},
                {"step": 1},
                {"pipeline": {}, "step": "one"},
                {"step": 1, "pipeline": 3},
                [1, 2],
                torch.ones(3),
            )
        ),
        *(
            (with_parameter(name, value), "checkpoint")
            for name in ("means", "features_dc", "codes")
            for value in (torch.ones(3), torch.ones(5, 7), torch.ones(0))
        ),
        (with_parameter("means", torch.full((5, 3), math.nan)), "number"),
        (with_parameter("means", torch.eye(3).to_sparse()), "sparse"),
        (None, "checkpoint"),
    ],
)
def test_checkpoints_of_other_methods_shapes_and_kinds_are_named(copy, change, message):
    path = max((copy / "nerfstudio_models").glob("*.ckpt"))
    if change is None:
        path.unlink()
        os.mkfifo(path)
    else:
        torch.save(change(torch.load(path, weights_only=True)), path)
    for opening in (load_scene, open_run):
        with pytest.raises(UserError, match=message):
            opening(copy / "config.yml")


@pytest.mark.parametrize("content", [b"G", b"\x80\x02J", b"M", b"\x80\x02]q\xff", b"PK\x03\x04"])
def test_bytes_that_end_in_the_middle_of_a_pickle_are_no_checkpoint(tmp_path, content):
    (tmp_path / "step-000000001.ckpt").write_bytes(content)
    with pytest.raises(UserError, match="not a checkpoint of lang3dxl"):
        read_checkpoint(tmp_path / "step-000000001.ckpt")


def test_a_checkpoint_that_would_fill_the_memory_is_refused(copy):
    path = max((copy / "nerfstudio_models").glob("*.ckpt"))
    state = torch.load(path, weights_only=True)
    (key,) = [k for k in state["pipeline"] if k.endswith("gauss_params.means")]
    state["pipeline"][key] = torch.zeros(1).expand(10**12, 3)
    torch.save(state, path)
    assert path.stat().st_size < 1e8
    for opening in (load_scene, open_run):
        with pytest.raises(UserError, match=r"means is larger than what is stored of it"):
            opening(copy / "config.yml")
    with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED) as archive:
        archive.writestr("step/data/0", bytes(10**8))
    with pytest.raises(UserError, match="packed"):
        load_scene(copy / "config.yml")


def test_the_config_of_another_method_is_named(copy):
    (copy / "config.yml").write_text(yaml.dump(all_methods["splatfacto"]))
    config = deepcopy(lang3dxl.config)
    config.load_dir, config.data, config.output_dir = copy / "nerfstudio_models", copy, copy / "outputs"
    for opening in (load_scene, open_run, lambda _: config.set_timestamp()):
        with pytest.raises(UserError, match="another method"):
            opening(copy / "config.yml")


# ── kinds that are not files, values of other kinds ─────────────────────────────────────────────────────


def test_a_config_that_can_not_be_looked_at_first_is_refused(tmp_path):
    os.mkfifo(tmp_path / "config.yml")
    with pytest.raises(SystemExit, match="can't be checked before it is used"):
        check_command_line(["--load-config", str(tmp_path / "config.yml")])
    with pytest.raises(SystemExit, match="can't be checked before it is used"):
        check_command_line(["--load-config", "/dev/null"])
    with pytest.raises(UserError, match="can't be read"):
        read_config(tmp_path / "config.yml")


@pytest.mark.parametrize(
    "sign",
    ["method_name: lang3dxl", 'method_name: "lang3dxl-paper"', "b: !!python/name:lang3dxl%5Fns.methods.x ''"],
)
def test_a_config_that_says_it_is_ours_is_checked_though_it_has_none_of_our_classes(tmp_path, sign):
    path = tmp_path / "config.yml"
    path.write_text(f"a: !!python/object/apply:os.system ['true']\n{sign}\n")
    with pytest.raises(SystemExit, match="holds more than settings"):
        check_command_line(["--load-config", str(path)])


def test_configs_of_other_methods_are_left_to_nerfstudio(tmp_path):
    """A plugin does not decide about commands of others."""
    path = tmp_path / "config.yml"
    path.write_text("a: !!python/object/apply:os.system ['true']\n")
    check_command_line(["--load-config", str(path)])


def test_photos_that_may_not_be_read_are_not_taken_for_gone(copy, monkeypatch):
    def refused(*_, **__):
        raise PermissionError(13, "Permission denied")

    monkeypatch.setattr("lang3dxl_ns.plugin.dataparser.open_capture", refused)
    with pytest.raises(PermissionError):
        open_run(copy / "config.yml")


def test_a_part_of_other_settings_is_named(tmp_path):
    config = deepcopy(lang3dxl.config)
    config.pipeline.model.semantic_field = DownsamplerConfig()
    (tmp_path / "config.yml").write_text(yaml.dump(config))
    with pytest.raises(UserError, match=r"sets pipeline\.model\.semantic_field to Downsampler"):
        read_config(tmp_path / "config.yml")


@pytest.mark.parametrize(
    "setting", ["    sh_degree: 3", "_target: !!python/name:lang3dxl_ns.plugin.trainer.Lang3DXLTrainer ''"]
)
def test_a_setting_of_a_million_values_is_told_in_a_line(tmp_path, setting):
    """Six levels of aliases, each ten times the one before, are a few bytes of a file."""
    levels = [f"&a{i} [{', '.join(10 * [f'*a{i - 1}'])}]" for i in range(1, 7)]
    text = yaml.dump(lang3dxl.config)
    assert setting in text
    many = f"{setting.partition(':')[0]}: [&a0 x, {', '.join(levels)}]"
    (tmp_path / "config.yml").write_text(text.replace(setting, many))
    with pytest.raises(UserError) as error:
        read_config(tmp_path / "config.yml")
    assert setting.partition(":")[0].strip() in str(error.value) and len(str(error.value)) < 500


@pytest.mark.parametrize(
    ("setting", "other"),
    [
        ("densify_every: 0.0", "densify_every: null #"),
        ("densify_from: 0.0", "densify_from: abc #"),
        ("sh_degree: 3", "sh_degree: null"),
        ("densify_until: 0.5", "densify_until: .nan"),
        ("background_color: black", "background_color: -5"),
        ("evaluated_photos: held-out", "evaluated_photos: test"),
        ("evaluated_photos: held-out", "evaluated_photos: [1]"),
    ],
)
def test_values_of_another_kind_are_named(tmp_path, setting, other):
    text = yaml.dump(lang3dxl.config)
    assert setting in text
    (tmp_path / "config.yml").write_text(text.replace(setting, other))
    with pytest.raises(UserError, match=f"sets .*{setting.partition(':')[0]}"):
        read_config(tmp_path / "config.yml")


def test_a_run_made_on_windows_opens(tmp_path):
    text = yaml.dump(lang3dxl.config)
    (tmp_path / "config.yml").write_text(text.replace("pathlib.PosixPath", "pathlib.WindowsPath"))
    assert read_config(tmp_path / "config.yml").relative_model_dir == lang3dxl.config.relative_model_dir


def test_a_copy_of_a_run_loads_its_own_checkpoint_in_nerfstudios_commands(copy, two_steps, monkeypatch):
    """As `ns-eval` reads it."""
    original = two_steps.base_dir
    config = yaml.load((copy / "config.yml").read_text(), Loader=yaml.Loader)
    assert config.get_checkpoint_dir().parent == original
    monkeypatch.setattr("sys.argv", ["/bin/ns-eval", "--load-config", str(copy / "config.yml")])
    assert config.get_checkpoint_dir().parent == copy
    config = yaml.load((copy / "config.yml").read_text(), Loader=yaml.Loader)
    assert config.pipeline.datamanager.run == copy
    monkeypatch.setattr("sys.argv", ["/bin/ns-train", "lang3dxl", "--load-config", str(copy / "config.yml")])
    assert config.get_base_dir() == original
