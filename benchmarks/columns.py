"""The metrics that a table may show, and which way each is good (no torch)."""

from extrap_train.config import LPIPS_NETS

HIGHER_IS_BETTER = {
    "psnr", "ssim", "masked_psnr", "masked_ssim", "unseen_psnr", "unseen_ssim", "compat_psnr",
    "compat_ssim", "tsed", "warp_psnr", "completeness", "accuracy_share", "f_score",
}  # fmt: skip
LOWER_IS_BETTER = {"dists", "seconds"} | {f"lpips_{net}" for net in LPIPS_NETS}
OF_THE_DRAW = {"coverage", "tsed_truth", "warp_psnr_truth"}
"""The same for every method."""
UNRANKED = {"peak_memory_mib", "accuracy_distance"}
"""No race: memory holds what earlier cells have left in the process, and the distance is of those
points alone that a method has, which may be few and good.
"""
COLUMNS = HIGHER_IS_BETTER | LOWER_IS_BETTER | OF_THE_DRAW | UNRANKED


def direction(metric: str) -> int:
    """1 where higher is better, -1 where lower is, 0 where neither: a property of the
    draw, or a number that ranks nobody.
    """
    if metric in HIGHER_IS_BETTER:
        return 1
    return -1 if metric in LOWER_IS_BETTER or metric.startswith("lpips") else 0
