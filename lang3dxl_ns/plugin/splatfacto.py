"""Splatfacto without torch's compiler, which takes a second to load for a function never called here."""

from nerfstudio.utils import misc

_compile = misc.torch_compile
misc.torch_compile = lambda *_, **__: lambda function: function
try:
    from nerfstudio.models.splatfacto import SplatfactoModel, SplatfactoModelConfig
finally:
    misc.torch_compile = _compile

__all__ = ["SplatfactoModel", "SplatfactoModelConfig"]
