"""ShiftNet, FastDVDnet and accelerated GAP as torch operations: what `sci` computes on a processor, differentiable, on any device of torch.

`python -m sci.gpu.train FILE.toml` trains on a GPU what `sci train FILE.toml` trains on a processor, and writes weights that `sci` reads. Needs torch,
safetensors and pillow (`pip install sci-video[gpu]`).
"""

from .networks import Fastdvdnet, Shiftnet
from .solver import cfa_planes, demosaic, mosaic, solve, total_variation, warm_start

__all__ = ["Fastdvdnet", "Shiftnet", "cfa_planes", "demosaic", "mosaic", "solve", "total_variation", "warm_start"]
