"""`lang3dxl view`: a trained scene in the viewer, for this machine alone."""

from __future__ import annotations

import os
from dataclasses import dataclass
from pathlib import Path


@dataclass(kw_only=True)
class View:
    """Walk through a trained scene and ask it: nerfstudio's viewer, which only this machine can open.

    (`ns-viewer` does the same, open to the whole network unless told otherwise.)
    """

    load_config: Path
    """config.yml of the run."""
    text: str = ""
    """What to look for at first."""
    host: str = "127.0.0.1"
    """Address to serve at; 0.0.0.0 lets the network in."""
    port: int | None = None
    """Port to serve at; a free one from 7007 on by default."""

    def main(self) -> None:
        from nerfstudio.scripts.viewer.run_viewer import RunViewer, ViewerConfigWithoutNumRays

        from lang3dxl_ns.pipeline import QUERY_VARIABLE

        if self.text:
            os.environ[QUERY_VARIABLE] = self.text
        viewer = ViewerConfigWithoutNumRays(websocket_host=self.host, websocket_port=self.port)
        RunViewer(self.load_config, viewer).main()
