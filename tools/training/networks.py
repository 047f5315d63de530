"""The architectures of the shipped networks, in torch. Every one takes 8-bit RGB and normalises inside.

- ``NeighboursNet``: one image -> metric depth, drone mask, and each drone pixel's offset to its drone's centre.
- ``DistanceNet``: a small crop centred on one drone -> its range, centre and uncertainty.
- ``VerificationNet``: the same crop -> whether it shows a drone at all.
- ``FlowNet``: two images -> optical flow, by recurrent lookups in an all-pairs correlation (RAFT, Teed & Deng 2020).
"""

from __future__ import annotations

from collections.abc import Callable
from itertools import pairwise
from typing import TypeVar

import torch
from torch import Tensor, nn
from torch.nn import functional as F

from tools.training.dataset import MAX_DEPTH_M, MAX_FAMILIES

Out = TypeVar("Out")
PLANE_STEPS = torch.tensor([64.0, 64.0, 32.0])[:, None, None]
"""Steps per unit of the geometry's planes, where they enter an 8-bit network."""
OFFSET_SCALE_PX = 16.0
"""Centre offsets leave the network in units of this many pixels of the half-size map."""


def _conv(inputs: int, outputs: int, stride: int = 1, kernel: int = 3) -> nn.Sequential:
    return nn.Sequential(
        nn.Conv2d(inputs, outputs, kernel, stride, kernel // 2, bias=False), nn.BatchNorm2d(outputs), nn.ReLU(True)
    )


def _in_full_precision(layer: Callable[[Tensor], Out], x: Tensor) -> Out:
    """The layer in 32 bits, also if training runs in 16: metres need more than three digits."""
    with torch.autocast(x.device.type, enabled=False):
        return layer(x.float())


def _blocks(image: Tensor) -> Tensor:
    """(n, h, w, 3) uint8 -> (n, 12, h / 2, w / 2) in -1..1: blocks of 2 x 2 pixels become channels."""
    n, h, w, _ = image.shape
    x = image.reshape(n, h // 2, 2, w // 2, 2, 3).permute(0, 5, 2, 4, 1, 3)
    return (x.reshape(n, 12, h // 2, w // 2).float() - 128.0) / 127.5


def _entry(image: Tensor, *planes: Tensor) -> Tensor:
    """Input of the first layer at inference: the image's 2 x 2 blocks in grey levels minus 128, and planes.

    (n, h, w, 3) uint8 -> (n, 12 + ., h / 2, w / 2). Whole numbers from 0 to 255 less 128 are 8-bit numbers as they are:
    see ``tools.training.quantise``.
    """
    n, h, w, _ = image.shape
    blocks = image.reshape(n, h // 2, 2, w // 2, 2, 3).permute(0, 1, 3, 2, 4, 5)
    blocks = blocks.reshape(n, h // 2, w // 2, 12).permute(0, 3, 1, 2)
    return torch.cat([blocks.float() - 128.0, *planes], 1) if planes else blocks.float() - 128.0


def _on_entry(layer: nn.Sequential, entry: Tensor) -> Tensor:
    """The output of ``layer``, which is trained on ``_blocks``, for an input of ``_entry``."""
    convolution, norm = layer[0], layer[1]
    scale = norm.weight / torch.sqrt(norm.running_var + norm.eps)
    weight = (convolution.weight * scale[:, None, None, None]).detach()
    kernel = weight[:, :12].reshape(-1, 3, 2, 2, 3, 3).permute(0, 2, 3, 1, 4, 5).reshape(-1, 12, 3, 3) / 127.5
    bias = (norm.bias - norm.running_mean * scale).detach()
    if convolution.in_channels > 12:
        planes = weight[:, 12:15] / PLANE_STEPS
        kernel = torch.cat([kernel, planes, torch.zeros_like(planes[:, :1])], 1)
    return F.relu(F.conv2d(entry, kernel.clone(), bias, stride=convolution.stride, padding=1))


def first_layers_of(net: nn.Module, kernels: list[tuple[Tensor, Tensor]]) -> dict[str, Tensor]:
    """The trained weights from which ``_on_entry`` made these kernels and biases, without normalisation."""
    names = ["stem.0"] if isinstance(net, NeighboursNet | DistanceNet | VerificationNet) else []
    weights: dict[str, Tensor] = {}
    for name, (kernel, bias) in zip(names, kernels, strict=True):
        weight = kernel[:, :12].reshape(-1, 2, 2, 3, 3, 3).permute(0, 3, 1, 2, 4, 5).reshape(-1, 12, 3, 3) * 127.5
        if kernel.shape[1] > 12:
            weight = torch.cat([weight, kernel[:, 12:15] * PLANE_STEPS], 1)
        weights |= {f"{name}.weight": weight, f"{name}.bias": bias}
    return weights


class _Residual(nn.Module):
    def __init__(self, channels: int) -> None:
        super().__init__()
        self.first = _conv(channels, channels)
        self.second = nn.Sequential(nn.Conv2d(channels, channels, 3, 1, 1, bias=False), nn.BatchNorm2d(channels))

    def forward(self, x: Tensor) -> Tensor:
        return F.relu(x + self.second(self.first(x)))


class NeighboursNet(nn.Module):
    """U-Net that begins at a quarter of the image's size; its channels hold the finer detail.

    Inputs: image (n, h, w, 3) uint8; geometry (n, 3, h/2, w/2): tangents of the pixel's ray right and down of the
    optical axis. The third plane is the inverse depth in 1/m of flat ground as attitude and height say (0: unknown or
    sky). Outputs, at half size: depth (n, 1, ., .) metres; drone (n, 1, ., .) probability logit; offset (n, 2, ., .)
    from the pixel to its drone's centre, half-size pixels.
    """

    widths = (32, 56, 96, 128)

    def __init__(self) -> None:
        super().__init__()
        w = self.widths
        self.stem = _conv(12 + 3, w[0], stride=2)
        self.down = nn.ModuleList([_conv(a, b, stride=2) for a, b in pairwise(w)])
        self.body = nn.ModuleList([_Residual(b) for b in w[1:]])
        self.deep = nn.Sequential(_Residual(w[-1]), _Residual(w[-1]))
        self.context = nn.Sequential(nn.Linear(w[-1], w[-1]), nn.ReLU(True), nn.Linear(w[-1], w[-1]))
        self.lateral = nn.ModuleList([nn.Conv2d(a, a, 1) for a in w[:-1]])
        self.up = nn.ModuleList([_conv(b, a, kernel=1) for a, b in pairwise(w)])
        self.merge = nn.ModuleList([_conv(a, a) for a in w[:-1]])
        self.last = _conv(w[0], w[0])
        self.head = nn.Sequential(nn.Conv2d(w[0], 4 * 4, 1), nn.PixelShuffle(2))

    def forward(self, image: Tensor, geometry: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Depth, logit and offsets."""
        ground = geometry[:, 2:]
        known = ground > 0
        log_ground = torch.log(ground.clamp(min=1.0 / MAX_DEPTH_M))
        planes = torch.cat([geometry[:, :2], torch.where(known, log_ground + 3.0, torch.zeros_like(ground))], 1)
        if self.training:
            x = self.stem(torch.cat([_blocks(image), planes], 1))
        else:
            in_steps = planes * PLANE_STEPS
            x = _on_entry(self.stem, _entry(image, in_steps, in_steps[:, :1]))  # 16 channels are faster than 15
        levels = [x]
        for down, body in zip(self.down, self.body, strict=True):
            x = body(down(x))
            levels.append(x)
        x = self.deep(x)
        x = x + self.context(x.mean((2, 3)))[:, :, None, None]
        for i in reversed(range(len(self.merge))):
            x = F.interpolate(self.up[i](x), scale_factor=2.0, mode="nearest")
            x = self.merge[i](x + self.lateral[i](levels[i]))
        out = _in_full_precision(self.head, self.last(x))
        start = torch.where(known, -log_ground, torch.full_like(ground, 2.0))  # the network corrects flat ground
        depth = torch.exp((start + out[:, :1]).clamp(-3.0, 5.0)).clamp(max=MAX_DEPTH_M)
        return depth, out[:, 1:2], out[:, 2:4] * OFFSET_SCALE_PX


class _CropEncoder(nn.Module):
    """Features of crops of 96 x 96 pixels, at a half to a 32nd of that size; `distance` and `verification` each learn
    their own."""

    widths = (24, 40, 64, 96, 128)

    def __init__(self) -> None:
        super().__init__()
        w = self.widths
        self.stem = _conv(12, w[0])  # 48
        self.down = nn.ModuleList([_conv(a, b, stride=2) for a, b in pairwise(w)])  # 24, 12, 6, 3
        self.body = nn.ModuleList([_Residual(b) for b in w[1:]])
        self.more = nn.ModuleDict({str(i): _Residual(w[i]) for i in (2, 3)})

    def levels(self, picture: Tensor) -> list[Tensor]:
        """The features of (n, 96, 96, 3) uint8, the finest first."""
        x = self.stem(_blocks(picture)) if self.training else _on_entry(self.stem, _entry(picture))
        found = [x]
        for i, (down, body) in enumerate(zip(self.down, self.body, strict=True), start=1):
            x = body(down(found[-1]))
            found.append(self.more[str(i)](x) if str(i) in self.more else x)
        return found


class DistanceNet(_CropEncoder):
    """Range of the drone in the middle of a crop.

    Maps of half the crop's size say where its four motors are, from the leftmost to the rightmost; how far they lie
    apart tells how large the drone appears, to a fraction of a pixel. What the whole crop tells which
    shape of drone it is, hence its size in metres. Range is one over the other.

    Input: `picture` (n, 96, 96, 3) uint8, the crop of a virtual camera that faces the drone. Outputs (n, 7):
    log of (range in m / focal length in px), the drone's centre right and down of the crop's centre in px,
    log of the standard deviation of the first for a drone of a known shape, logit of there being a drone at all, log of
    the drone's size in px as it would appear from the side (its size in m times focal length over range), log of the
    standard deviation of the logarithm of its size in m, by which the first errs as well. And (n, 96, 96): for each
    pixel the logit of being this drone's.
    """

    motors = 4
    maps = 8
    """The first are the motors; the others are learnt."""

    def __init__(self) -> None:
        super().__init__()
        w = self.widths
        self.lateral = nn.ModuleList([nn.Conv2d(a, a, 1) for a in w[:4]])
        self.up = nn.ModuleList([_conv(b, a, kernel=1) for a, b in pairwise(w)])
        self.merge = nn.ModuleList([_conv(a, a) for a in w[:4]])
        self.look = nn.Conv2d(w[0], self.maps, 1)
        self.mask = nn.Sequential(_conv(w[0], w[0]), nn.Conv2d(w[0], 4, 1), nn.PixelShuffle(2))
        self.summary = nn.Sequential(nn.Linear(128 * 9 + 6 * self.maps + 2, 160), nn.ReLU(True))
        self.thought = nn.Sequential(nn.Linear(160, 160), nn.ReLU(True), nn.Linear(160, 160))
        self.head = nn.Linear(160, 6)
        self.doubt = nn.Sequential(nn.Linear(self.summary[0].in_features + 160, 64), nn.ReLU(True), nn.Linear(64, 1))
        for last in (*(block.second[1] for block in self.more.values()), self.thought[2], self.doubt[2]):
            nn.init.zeros_(last.weight)  # what is added to a trained network changes nothing at first
            nn.init.zeros_(last.bias)
        self.family = nn.Linear(160, MAX_FAMILIES)

    def forward(self, picture: Tensor) -> tuple[Tensor, ...]:
        """One row and one mask a crop.

        In training also a logit for each family, and log maps of the motors (n, 4, 48 * 48).
        """
        levels = self.levels(picture)
        x = levels[-1]
        whole = x.flatten(1)
        for i in reversed(range(len(self.merge))):
            x = F.interpolate(self.up[i](x), scale_factor=2.0, mode="nearest")
            x = self.merge[i](x + self.lateral[i](levels[i]))
        where, mask = _in_full_precision(self.look, x), self.mask(x)[:, 0]
        middles, moments = _in_full_precision(_moments, where)
        spread, shape = _spread(middles[:, : self.motors])
        seen = torch.cat([whole.float(), moments, shape], 1)
        x = _in_full_precision(self.summary, seen)
        x = x + _in_full_precision(self.thought, x)
        out = _in_full_precision(self.head, x)
        apparent = spread + out[:, 5:] + 1.0
        doubt = (_in_full_precision(self.doubt, torch.cat([seen, x], 1)) - 5.0).clamp(-7.0, 1.0)
        sigma = (out[:, 3:4] - 3.0).clamp(-7.0, 1.0)
        out = torch.cat([out[:, :1] - 0.5 - apparent, out[:, 1:3] * 10.0, sigma, out[:, 4:5], apparent, doubt], 1)
        if not self.training:
            return out, mask
        return out, mask, _in_full_precision(self.family, x), where[:, : self.motors].flatten(2).log_softmax(2)


class VerificationNet(_CropEncoder):
    """Whether there is a drone in the middle of a crop.

    It is trained apart from ``DistanceNet``: what tells a drone from a bird or a branch has to be learnt from soft real
    photographs, of which nobody knows a range.

    Input: `crop` (n, 96, 96, 3) uint8, as ``DistanceNet`` takes it. Output (n, 1): logit of there being a drone.
    """

    def __init__(self) -> None:
        super().__init__()
        self.summary = nn.Sequential(nn.Linear(self.widths[-1] * 9, 160), nn.ReLU(True), nn.Dropout(0.2))
        self.head = nn.Linear(160, 1)

    def forward(self, crop: Tensor) -> Tensor:
        """One logit (n, 1) a crop."""
        return _in_full_precision(self.head, self.summary(self.levels(crop)[-1].flatten(1)))


def _moments(where: Tensor) -> tuple[Tensor, Tensor]:
    """Moments of maps (n, k, h, w) of logits: their middles (n, k, 2) in crop pixels, and all their moments (n, 6
    k)."""
    n, k, h, w = where.shape
    flat = where.flatten(2)
    v, u = torch.meshgrid(torch.arange(h).float() + 0.5 - h / 2, torch.arange(w).float() + 0.5 - w / 2, indexing="ij")
    u, v = 2.0 * u.to(where.device).flatten(), 2.0 * v.to(where.device).flatten()
    m = torch.matmul(flat.softmax(2), torch.stack([u, v, u * u, u * v, v * v], 1))
    mu, mv = m[..., 0], m[..., 1]
    uu, uv, vv = m[..., 2] - mu * mu + 1.0, m[..., 3] - mu * mv, m[..., 4] - mv * mv + 1.0
    spread = (uu + vv).clamp(min=0.5).log() / 2
    features = torch.cat([mu / 20.0, mv / 20.0, spread, (uu - vv) / (uu + vv), uv / (uu + vv), flat.amax(2) / 10.0], 1)
    return torch.stack([mu, mv], 2), features.reshape(n, 6 * k)


def _spread(points: Tensor) -> tuple[Tensor, Tensor]:
    """Log of the widest spread (n, 1) of points (n, k, 2) in px, and the shape of the cloud (n, 2).

    The motors of a level drone lie on a circle or nearly so: from the side, at any heading, they spread about alike.
    """
    centred = points - points.mean(1, keepdim=True)
    uu, vv = (centred**2).mean(1).unbind(1)
    uv = (centred[..., 0] * centred[..., 1]).mean(1)
    half, difference = (uu + vv) / 2, torch.sqrt(((uu - vv) / 2) ** 2 + uv**2 + 1e-3)
    wide = (half + difference).clamp(min=1.0).log() / 2
    narrow = (half - difference).clamp(min=0.3).log() / 2
    return wide[:, None], torch.stack([wide - 2.5, narrow - wide + 1.0], 1)


class _Encoder(nn.Module):
    """Features at an eighth of its input's size."""

    def __init__(self, outputs: int) -> None:
        super().__init__()
        self.layers = nn.Sequential(
            _conv(12, 24),
            _Residual(24),
            _conv(24, 48, stride=2),
            _Residual(48),
            _conv(48, 80, stride=2),
            _Residual(80),
            nn.Conv2d(80, outputs, 1),
        )

    def forward(self, x: Tensor) -> Tensor:
        return self.layers(F.pixel_unshuffle(x, 2))


class _Gru(nn.Module):
    def __init__(self, hidden: int, inputs: int) -> None:
        super().__init__()
        self.gates = nn.Conv2d(hidden + inputs, 2 * hidden, 3, 1, 1)
        self.candidate = nn.Conv2d(hidden + inputs, hidden, 3, 1, 1)

    def forward(self, h: Tensor, x: Tensor) -> Tensor:
        z, r = torch.sigmoid(self.gates(torch.cat([h, x], 1))).chunk(2, 1)
        return (1 - z) * h + z * torch.tanh(self.candidate(torch.cat([r * h, x], 1)))


class FlowNet(nn.Module):
    """Recurrent all-pairs flow that begins at the best match of the whole image.

    Inputs: first, second (n, h, w, 3) uint8, h and w multiples of 8. Output: flow (n, 2, h, w) in pixels of its input,
    from first to second. In training a list, one flow an iteration.
    """

    hidden, context, feature, radius, levels = 48, 40, 96, 3, 2

    def __init__(self, iterations: int = 3) -> None:
        super().__init__()
        self.iterations = iterations
        self.encoder = _Encoder(self.feature)
        self.sharpness = nn.Parameter(torch.tensor(1.0))
        self.initial = nn.Sequential(_conv(self.feature, 96), nn.Conv2d(96, self.hidden + self.context, 1))
        lookups = self.levels * (2 * self.radius + 1) ** 2
        self.correlation = nn.Sequential(nn.Conv2d(lookups, 64, 1), nn.ReLU(True))
        self.motion = nn.Sequential(nn.Conv2d(2, 16, 3, 1, 1), nn.ReLU(True))
        self.fuse = nn.Sequential(nn.Conv2d(80, 62, 3, 1, 1), nn.ReLU(True))
        self.gru = _Gru(self.hidden, self.context + 64)
        self.delta = nn.Sequential(nn.Conv2d(self.hidden, 64, 3, 1, 1), nn.ReLU(True), nn.Conv2d(64, 2, 3, 1, 1))
        self.mask = nn.Sequential(nn.Conv2d(self.hidden, 96, 3, 1, 1), nn.ReLU(True), nn.Conv2d(96, 9 * 64, 1))

    def forward(self, first: Tensor, second: Tensor) -> Tensor | list[Tensor]:
        """The last iteration's flow, or in training that of each."""
        both = torch.cat([first, second], 0).permute(0, 3, 1, 2).float() / 127.5 - 1.0
        features = self.encoder(both)
        n = first.shape[0]
        f1, f2 = features[:n], features[n:]
        h, w = f1.shape[2], f1.shape[3]
        pyramid = self._pyramid(f1, f2, n, h, w)
        start = self.initial(f1)
        hidden, context = torch.tanh(start[:, : self.hidden]), F.relu(start[:, self.hidden :])
        grid = self._grid(n, h, w, start.float())
        match = (pyramid[0].float() * torch.exp(self.sharpness)).reshape(n, h * w, h * w).softmax(2)
        flow = torch.matmul(match, grid.flatten(2).transpose(1, 2)).transpose(1, 2).reshape(n, 2, h, w) - grid
        flows: list[Tensor] = []
        if self.training:
            flows.append(F.interpolate(flow * 8.0, scale_factor=8.0, mode="bilinear", align_corners=False))
        for step in range(self.iterations):
            flow = flow.detach()
            found = self.correlation(self._lookup(pyramid, grid + flow, n, h, w))
            motion = self.fuse(torch.cat([found, self.motion(flow)], 1))
            hidden = self.gru(hidden, torch.cat([context, motion, flow], 1))
            flow = flow + self.delta(hidden)
            if self.training or step == self.iterations - 1:
                flows.append(self._upsample(flow, hidden, n, h, w))
        return flows if self.training else flows[-1]

    def _pyramid(self, f1: Tensor, f2: Tensor, n: int, h: int, w: int) -> list[Tensor]:
        volumes = []
        flat = f1.flatten(2).transpose(1, 2) / self.feature**0.5
        for level in range(self.levels):
            target = f2 if level == 0 else F.avg_pool2d(f2, 2**level, ceil_mode=True)
            volume = torch.matmul(flat, target.flatten(2))
            volumes.append(volume.reshape(n * h * w, 1, target.shape[2], target.shape[3]))
        return volumes

    @staticmethod
    def _grid(n: int, h: int, w: int, like: Tensor) -> Tensor:
        v, u = torch.meshgrid(
            torch.arange(h, dtype=like.dtype, device=like.device),
            torch.arange(w, dtype=like.dtype, device=like.device),
            indexing="ij",
        )
        return torch.stack([u, v])[None].expand(n, 2, h, w)

    def _lookup(self, pyramid: list[Tensor], at: Tensor, n: int, h: int, w: int) -> Tensor:
        r = self.radius
        d = torch.arange(-r, r + 1, dtype=at.dtype, device=at.device)
        dv, du = torch.meshgrid(d, d, indexing="ij")
        window = torch.stack([du, dv], -1)[None]
        centre = at.permute(0, 2, 3, 1).reshape(n * h * w, 1, 1, 2)
        found = []
        for level, volume in enumerate(pyramid):
            place = (centre + 0.5) / 2**level + window  # from here on pixel edges, so that levels line up
            u = place[..., :1] * (2.0 / volume.shape[3]) - 1.0
            v = place[..., 1:] * (2.0 / volume.shape[2]) - 1.0
            sampled = F.grid_sample(volume.float(), torch.cat([u, v], -1), align_corners=False)
            found.append(sampled.reshape(n, h, w, -1))
        return torch.cat(found, -1).permute(0, 3, 1, 2)

    def _upsample(self, flow: Tensor, hidden: Tensor, n: int, h: int, w: int) -> Tensor:
        weights = torch.exp(self.mask(hidden).clamp(-8.0, 8.0)).reshape(n, 9, 64, h, w)
        edged = F.pad(flow * 8.0, (1, 1, 1, 1))
        near = torch.stack([edged[:, :, i : i + h, j : j + w] for i in range(3) for j in range(3)], 2)
        total = weights.sum(1)
        fine = torch.cat([(weights * near[:, i, :, None]).sum(1) / total for i in (0, 1)], 1)
        return F.pixel_shuffle(fine, 8)
