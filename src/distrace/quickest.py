"""Which form of a decoder this machine is quickest with, where values may be rounded."""

from functools import lru_cache

import torch

from distrace.decoder import Decoder
from distrace.laid_out import LaidOut
from distrace.rounded import Rounded


def quickest(decoder: Decoder) -> Decoder | Rounded:
    """The decoder as it is, or rounded: on a CPU that multiplies in bfloat16. Others emulate that, and take longer.

    A decoder of another class is asked as it is: it may have another field.
    """
    parameter = next(decoder.parameters())
    if type(decoder) is not Decoder or parameter.device.type != "cpu" or parameter.dtype != torch.float32:
        return decoder
    if not _multiplies_in_bfloat16():
        return decoder
    return LaidOut(decoder) if LaidOut.has(decoder) else Rounded(decoder)


@lru_cache
def _multiplies_in_bfloat16() -> bool:
    """As the processor says it, not a stopwatch: so that a fit that is run again ends where it did."""
    capabilities = getattr(torch.cpu, "get_capabilities", dict)()  # PyTorch before 2.10 does not tell
    return any(capabilities.get(name) for name in ("avx512_bf16", "amx_bf16"))
