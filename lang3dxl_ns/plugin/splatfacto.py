"""Splatfacto without torch's compiler, which takes a second to load for a function never called here."""

from unittest import mock

with mock.patch("nerfstudio.utils.misc.torch_compile", return_value=lambda function: function):
    from nerfstudio.models.splatfacto import RGB2SH, SplatfactoModel, SplatfactoModelConfig, num_sh_bases

__all__ = ["RGB2SH", "SplatfactoModel", "SplatfactoModelConfig", "num_sh_bases"]
