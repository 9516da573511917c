"""Every Gaussian at every pixel, written as the equations are, for autograd to differentiate.

No tiles, no boxes, no sharing with the product: conics by matrix inversion, light by cumulative
products.
"""

import torch


def rasterize(means, quats, scales, opacities, colors, viewmat, k, width, height, background=None):
    """(h w d) colours and (h w) alpha, and (h w) accumulated depth, of one camera."""
    cam = means @ viewmat[:3, :3].T + viewmat[:3, 3]
    shown = torch.isfinite(cam).all(1) & (cam[:, 2] >= 0.01)
    index = torch.nonzero(shown)[:, 0]
    index = index[torch.argsort(cam[index, 2], stable=True)]
    cam, colors, opacities = cam[index], colors[index], opacities[index]
    x, y, z = cam.unbind(-1)
    fx, fy, cx, cy = k[0, 0], k[1, 1], k[0, 2], k[1, 2]

    half_x, half_y = 0.15 * width / fx, 0.15 * height / fy
    tx = torch.clamp(x / z, -cx / fx - half_x, (width - cx) / fx + half_x) * z
    ty = torch.clamp(y / z, -cy / fy - half_y, (height - cy) / fy + half_y) * z
    zero = torch.zeros_like(z)
    jacobian = torch.stack(
        [
            torch.stack([fx / z, zero, -fx * tx / z**2], -1),
            torch.stack([zero, fy / z, -fy * ty / z**2], -1),
        ],
        1,
    )
    turned = viewmat[:3, :3] @ quaternion_matrix(quats[index])
    cov3d = turned @ torch.diag_embed(scales[index] ** 2) @ turned.mT
    cov2d = jacobian @ cov3d @ jacobian.mT + 0.3 * torch.eye(2, dtype=means.dtype)
    conic = torch.linalg.inv(cov2d)

    rows, columns = torch.meshgrid(
        torch.arange(height, dtype=means.dtype) + 0.5,
        torch.arange(width, dtype=means.dtype) + 0.5,
        indexing="ij",
    )
    center = torch.stack([fx * x / z + cx, fy * y / z + cy], -1)
    offset = torch.stack([columns, rows], -1)[None] - center[:, None, None]
    exponent = 0.5 * torch.einsum("nhwi,nij,nhwj->nhw", offset, conic, offset)
    alpha = (opacities[:, None, None] * torch.exp(-exponent)).clamp(max=0.999)
    alpha = torch.where(alpha >= 1 / 255, alpha, 0)
    light = torch.cumprod(1 - alpha, 0)
    alpha = torch.where(light > 1e-4, alpha, 0)  # the first to fail stops all behind it, too
    light = torch.cumprod(torch.cat([torch.ones_like(alpha[:1]), 1 - alpha]), 0)
    weight = alpha * light[:-1]
    image = torch.einsum("nhw,nd->hwd", weight, colors)
    if background is not None:
        image = image + light[-1][..., None] * background
    return image, 1 - light[-1], torch.einsum("nhw,n->hw", weight, z)


def quaternion_matrix(quats):
    """Rotate the unit vectors by q v q*, component by component."""
    q = quats / quats.norm(dim=1, keepdim=True)
    w, v = q[:, :1], q[:, 1:]
    columns = []
    for axis in torch.eye(3, dtype=quats.dtype):
        e = axis.expand_as(v)
        t = 2 * torch.linalg.cross(v, e)
        columns.append(e + w * t + torch.linalg.cross(v, t))
    return torch.stack(columns, -1)
