"""PyTorch on the CPU: `grid_sample`, `index_add_`. Not a dependency: measured where it is there."""

import importlib

import numpy as np

torch = importlib.import_module("torch")


use_threads = torch.set_num_threads


def forward_warp(field, flow):
    """Four `index_add_` for each picture."""
    height, width, channels = field.shape[1:]
    y, x = torch.meshgrid(torch.arange(height), torch.arange(width), indexing="ij")

    def one(picture, along):
        whole = torch.floor(along)
        f = along - whole
        left, top = x + whole[..., 0].long(), y + whole[..., 1].long()
        ones = torch.ones(height, width, 1)
        extended = torch.cat([picture, ones], -1).reshape(-1, channels + 1)
        total = torch.zeros(height * width, channels + 1)
        for dy in (0, 1):
            for dx in (0, 1):
                share = (f[..., 0] if dx else 1 - f[..., 0]) * (f[..., 1] if dy else 1 - f[..., 1])
                tx, ty = left + dx, top + dy
                inside = ((tx >= 0) & (tx < width) & (ty >= 0) & (ty < height)).ravel()
                target = (ty * width + tx).ravel()[inside]
                total.index_add_(0, target, (share.reshape(-1, 1) * extended)[inside])
        weight = total[:, channels:]
        mean = torch.where(weight > 0, total[:, :channels] / weight, 0)
        return mean.reshape(height, width, channels), weight.reshape(height, width)

    given = zip(torch.from_numpy(field), torch.from_numpy(flow), strict=True)
    pairs = [one(a, b) for a, b in given]
    return tuple(torch.stack(part).numpy() for part in zip(*pairs, strict=True))


def sample(field, points):
    """`grid_sample`, channels first."""
    height, width = field.shape[1:3]
    planes = torch.from_numpy(np.ascontiguousarray(np.moveaxis(field, -1, 1)))
    unit = torch.tensor([2 / (width - 1), 2 / (height - 1)])
    options = {"mode": "bilinear", "padding_mode": "border", "align_corners": True}
    grid = (torch.from_numpy(points) * unit - 1)[:, None]
    found = torch.nn.functional.grid_sample(planes, grid, **options)
    return found[:, :, 0].movedim(1, -1).contiguous().numpy()


def blend(images, weights):
    """One product with a row of weights."""
    flat, shares = torch.from_numpy(images.reshape(len(images), -1)), torch.from_numpy(weights)
    return (shares @ flat).numpy().reshape(-1, *images.shape[1:])


def normal_equations(images, wanted):
    """Two products."""
    rows, column = torch.from_numpy(images.reshape(len(images), -1)), torch.from_numpy(wanted)
    return torch.vstack([rows @ rows.T, column.reshape(1, -1) @ rows.T]).numpy()


def distance_scan(queries, corpus, weights):
    """A row of the corpus at a time, channels first."""
    q, c = (
        torch.from_numpy(np.ascontiguousarray(np.moveaxis(a, -1, 0))) for a in (queries, corpus)
    )
    w = torch.from_numpy(weights)
    rows = [torch.hypot(q[0] - c[0, n], q[1] - c[1, n]) @ w for n in range(len(corpus))]
    return torch.stack(rows, 1).numpy()


def evaluate_rbf(points, centres, weights, affine, sharpness):
    """All Gaussians at once."""
    p, c, w, a = (torch.from_numpy(x) for x in (points, centres, weights, affine))
    squares = torch.cdist(p, c) ** 2
    return (a[:, 0] + p @ a[:, 1:].T + torch.exp(-sharpness * squares) @ w).numpy()
