"""Defaults of training, by name."""

from .config import DensifyConfig, LossConfig, ModelConfig, OptimConfig, Schedule, TrainConfig

PRESETS: dict[str, TrainConfig] = {
    "paper": TrainConfig(),
    "best": TrainConfig(
        preset="best",
        stage1_joint=True,
        static_geometry=True,
        static_appearance=True,
        antialias=True,
        model=ModelConfig(
            position_bands=6, time_bands=6, min_period=4.0, appearance_depth=4, appearance_width=128, sh_degree=3
        ),
        loss=LossConfig(dynamic_background="black", depth_tolerance=0.03, mask_margin=0.008),
        optim=OptimConfig(means=1.7e-3),
        densify=DensifyConfig(gradient=3e-4),
        schedule=Schedule(
            pretrain=400,
            stage1=7_500,
            stage2=7_100,
            realign_at=200,
            densify_from=100,
            densify_until=4_500,
            reset_every=1_100,
            prune_every=1_500,
            deform_from=400,
            warmup=400,
            noise_until=3_750,
            sh_degree_every=400,
        ),
        checkpoint_every=2_500,
    ),
    "fast": TrainConfig(
        preset="fast",
        schedule=Schedule(
            pretrain=1_000,
            stage1=4_000,
            stage2=10_000,
            realign_at=500,
            densify_from=300,
            densify_until=3_500,
            reset_every=2_500,
            prune_every=2_000,
            deform_from=500,
            warmup=500,
            noise_until=3_500,
            sh_degree_every=500,
        ),
        checkpoint_every=2_500,
    ),
    "quick": TrainConfig(
        preset="quick",
        model=ModelConfig(
            position_bands=6, time_bands=4, depth=3, width=64, skip=2, max_static_points=4_000, dynamic_points=1_500
        ),
        loss=LossConfig(ssim=0.0),
        optim=OptimConfig(means=3.2e-4, sh_dc=1e-2, networks=3e-3, networks_end=1e-4),
        densify=DensifyConfig(gradient=4e-4, max_gaussians=10_000),
        schedule=Schedule(
            pretrain=200,
            stage1=1_000,
            stage2=1_000,
            realign_at=100,
            densify_from=100,
            densify_until=700,
            reset_every=10_000,
            prune_every=500,
            deform_from=50,
            warmup=100,
            noise_until=400,
            sh_degree_every=400,
        ),
        checkpoint_every=500,
    ),
}
"""Defaults by name."""
