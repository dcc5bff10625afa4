"""LPIPS as torchmetrics computes it; run as a program of its own.

    python reference_lpips.py INPUT.pt OUTPUT.pt

torchmetrics takes the backbone from torchvision, which does not load beside a CPU build of torch. Here a module of
that name that holds nothing but AlexNet stands in for it, which is why this cannot run inside the test process. INPUT
holds predictions and targets [B, 3, H, W] in [0, 1] and the weights of AlexNet; OUTPUT the distances and the distance
maps.
"""

import sys
import types

import torch
from torch import nn


class AlexNet(nn.Module):
    """The feature layers of torchvision's AlexNet, in its numbering."""

    def __init__(self):
        super().__init__()
        self.features = nn.Sequential(
            nn.Conv2d(3, 64, kernel_size=11, stride=4, padding=2),
            nn.ReLU(inplace=True),
            nn.MaxPool2d(kernel_size=3, stride=2),
            nn.Conv2d(64, 192, kernel_size=5, padding=2),
            nn.ReLU(inplace=True),
            nn.MaxPool2d(kernel_size=3, stride=2),
            nn.Conv2d(192, 384, kernel_size=3, padding=1),
            nn.ReLU(inplace=True),
            nn.Conv2d(384, 256, kernel_size=3, padding=1),
            nn.ReLU(inplace=True),
            nn.Conv2d(256, 256, kernel_size=3, padding=1),
            nn.ReLU(inplace=True),
            nn.MaxPool2d(kernel_size=3, stride=2),
        )


def main():
    import torchmetrics.functional.image.lpips as lpips

    # The stand-in comes after the import: were it there before, torchmetrics would look for the rest of torchvision.
    torchvision = types.ModuleType("torchvision")
    torchvision.models = types.ModuleType("torchvision.models")
    pictures, weights = torch.load(sys.argv[1])
    backbone = AlexNet()
    backbone.load_state_dict({name: value.float() for name, value in weights.items() if name.startswith("features")})
    torchvision.models.alexnet = lambda weights: backbone
    torchvision.models.AlexNet_Weights = types.SimpleNamespace(DEFAULT=None)
    sys.modules["torchvision"] = torchvision
    sys.modules["torchvision.models"] = torchvision.models
    lpips._TORCHVISION_AVAILABLE = True
    distance, distance_map = (lpips._LPIPS(net="alex", spatial=spatial) for spatial in (False, True))
    results = {
        "distances": distance(*pictures, normalize=True).flatten(),
        "maps": distance_map(*pictures, normalize=True)[:, 0],
    }
    torch.save(results, sys.argv[2])


if __name__ == "__main__":
    main()
