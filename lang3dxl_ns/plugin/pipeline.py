"""Pipeline: data manager and model, evaluation, and readable errors."""

from __future__ import annotations

import os
import sys
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from functools import cached_property, partial
from pathlib import Path
from types import TracebackType
from typing import Any

from nerfstudio.pipelines.base_pipeline import VanillaPipeline, VanillaPipelineConfig
from nerfstudio.utils.rich_utils import CONSOLE
from rich.markup import escape
from torch import Tensor

from lang3dxl_ns.common.checks import disk_trouble
from lang3dxl_ns.common.console import accept_any_console, say
from lang3dxl_ns.common.errors import UserError, readable
from lang3dxl_ns.evaluation.score_run import Evaluation, EvaluationSettings
from lang3dxl_ns.plugin.datamanager import Lang3DXLDataManager, Lang3DXLDataManagerConfig
from lang3dxl_ns.plugin.load_scene import model_state
from lang3dxl_ns.plugin.model import Lang3DXLModel, Lang3DXLModelConfig, RenderedAnswers
from lang3dxl_ns.plugin.panel import AskPanel
from lang3dxl_ns.scene.record import SCENE_FILE, SceneRecord
from lang3dxl_ns.things.find import things_of
from lang3dxl_ns.things.outlines import outlined
from lang3dxl_ns.training.learn_codes import begin_codes, learn_words
from lang3dxl_ns.training.snapshot import snapshot

QUERY_VARIABLE = "LANG3DXL_QUERY"


@dataclass
class Lang3DXLPipelineConfig(EvaluationSettings, VanillaPipelineConfig):
    """Settings of the pipeline."""

    _target: type = field(default_factory=lambda: Lang3DXLPipeline)
    datamanager: Lang3DXLDataManagerConfig = field(default_factory=Lang3DXLDataManagerConfig)
    model: Lang3DXLModelConfig = field(default_factory=Lang3DXLModelConfig)
    query: str = ""
    """Prompts for `ns-render` ("rose window; dome"), and the viewer's initial ones. The environment variable
    LANG3DXL_QUERY overrides this."""


class Lang3DXLPipeline(VanillaPipeline):
    """nerfstudio's pipeline, which loads checkpoints strictly, and evaluates colors, features and words."""

    config: Lang3DXLPipelineConfig
    datamanager: Lang3DXLDataManager
    model: Lang3DXLModel
    last_losses: dict[str, Tensor]
    """Weighted losses of the latest training step."""

    def __init__(self, *args, **kwargs):
        print_user_errors_plainly()
        super().__init__(*args, **kwargs)
        # nerfstudio's viewer looks for controls among the pipeline's attributes.
        self.panel = AskPanel(self)

    @cached_property
    def evaluation(self) -> Evaluation:
        """Evaluation of the present model. Raises UserError for a run whose photos are gone."""
        if self.datamanager.data.capture.source is None:
            raise UserError(
                "this run can't be evaluated without the photos that it was trained on (see above): restore "
                "them, or correct data in its config.yml. `lang3dxl evaluate run NAME.scene --ground-truth "
                "FOLDER` scores its words alone"
            )
        return Evaluation(self.model.run, self.datamanager.data, self.config)

    def get_average_eval_image_metrics(
        self, step: int | None = None, output_path: Path | None = None, get_std: bool = False
    ) -> dict[str, Any]:
        """Return `Evaluation.scored` for `ns-eval` and the trainer; for `ns-eval` also print the figures."""
        results = self.evaluation.scored(output_path, get_std)
        if get_std:
            means = {n: v for n, v in results.items() if isinstance(v, float) and not n.endswith("_std")}
            say(*(f"{name:24} {value:10.4g}" for name, value in means.items()))
        return results

    def get_train_loss_dict(self, step: int):
        """Compute outputs, losses and metrics of the next photo; codes that start from photos come first."""
        begin_codes(self.model.run, self.datamanager.data)
        outputs, losses, metrics = super().get_train_loss_dict(step)
        self.last_losses = {name: loss.detach() for name, loss in losses.items()}
        return outputs, losses, metrics

    @property
    def query(self) -> str:
        """The prompts for renderings: the environment variable's, or else the configured ones."""
        return os.environ.get(QUERY_VARIABLE) or self.config.query

    @cached_property
    def scene_file(self) -> SceneRecord:
        """Description of the scene: the photos' names and cameras, and the CLIP."""
        run = self.datamanager.config.run
        if run is not None and (run / SCENE_FILE).is_file():
            return SceneRecord.read(run / SCENE_FILE)
        return self.datamanager.data.record()

    def load_pipeline(self, loaded_state: dict[str, Any], step: int) -> None:
        """Load a checkpoint; for rendering, also prepare to answer the configured prompts."""
        super().load_pipeline(loaded_state, step)
        self.model.refuses_lenses = self.test_mode == "inference"
        if self.test_mode != "val" and self.query:
            run = self.datamanager.config.run
            cache = None if run is None else run / "lang3dxl_visible.safetensors"
            CONSOLE.log(f"Looking for {escape(self.query)}")
            scene = snapshot(self.model.run, self.scene_file, cache=cache)
            question = scene.ask(self.query)
            # ns-render doesn't tell a model which outputs it wants, and finding things takes a while.
            things = things_of(scene, question) if "things" in sys.argv else []
            draw = partial(outlined, scene.splats, things) if things else None
            self.model.answers = RenderedAnswers(question, draw)

    def learn_words(self) -> None:
        """Gather the training photos' features onto the present Gaussians, and learn codes."""
        learn_words(self.model.run, self.datamanager.data)

    def load_state_dict(self, state_dict: Mapping[str, Any], strict: bool | None = None) -> None:  # type: ignore[override]
        """Load a checkpoint; any mismatch is an error (nerfstudio would silently ignore it)."""
        remedy = "load it with the config.yml beside it, or with the options that it was trained with"
        with readable("the checkpoint does not fit this configuration", remedy):
            self.model.load_state_dict(model_state(state_dict), strict=True)


def print_user_errors_plainly() -> None:
    """Make commands end on a `UserError` with its message alone, without a traceback, on any console."""
    accept_any_console()
    if not isinstance(sys.excepthook, _PlainErrors):
        sys.excepthook = _PlainErrors(sys.excepthook)


@dataclass(frozen=True)
class _PlainErrors:
    """Hook for uncaught exceptions, which prints users' errors itself and leaves the others to `others`."""

    others: Callable[[type[BaseException], BaseException, TracebackType | None], Any]

    def __call__(self, kind: type[BaseException], error: BaseException, trace: TracebackType | None) -> None:
        message = disk_trouble(error) if isinstance(error, OSError) else None
        message = str(error) if isinstance(error, UserError) else message
        if message is None:
            return self.others(kind, error, trace)
        CONSOLE.print(f"[bold red]Error:[/bold red] {escape(message)}", soft_wrap=True)
