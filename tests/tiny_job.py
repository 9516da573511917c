"""Options of a main job that takes seconds."""

TINY = [
    "category=hydrant",
    "data.train_sequences=2",
    "data.test_sequences=1",
    "data.frames=12",
    "data.image_size=32",
    "model.start=null",
    "model.image_size=16",
    "prep.image_size=32",
    "prep.max_gap_deg=60",
    "model.octaves=2",
    "model.unet.channels=[16,32]",
    "model.unet.attention_levels=[false,true]",
    "model.unet.heads=2",
    "model.unet.token_width=16",
    "trainer.batch_size=2",
    "threads=1",
]
