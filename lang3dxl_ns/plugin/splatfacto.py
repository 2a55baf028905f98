"""Splatfacto without torch's compiler, which takes a second to load for a function never called here."""

from nerfstudio.utils import misc

_compile = misc.torch_compile
misc.torch_compile = lambda *_, **__: lambda function: function
try:
    from nerfstudio.models.splatfacto import RGB2SH, SplatfactoModel, SplatfactoModelConfig, num_sh_bases
finally:
    misc.torch_compile = _compile

__all__ = ["RGB2SH", "SplatfactoModel", "SplatfactoModelConfig", "num_sh_bases"]
