"""What a saved adapter says of itself, in words and for programs: the scene it was made for."""

import shlex
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any


@dataclass(frozen=True)
class AdapterOrigin:
    """What an adapter was made from."""

    scene: str
    """Its address, the same from any folder."""
    photographs: Mapping[str, str]
    """SHA-256 of the content of the frames that it was trained on, by their names."""
    weights: str
    """Model folder, or a packaged model's name."""
    options: Mapping[str, Any]
    """By dotted key."""
    outcome: str
    """How its training ended."""


@dataclass(frozen=True)
class BaseHashes:
    """SHA-256 of the weights that an adapter belongs to."""

    denoiser: str
    others: str
    """Of the networks that tell the denoiser what to paint."""


@dataclass(frozen=True)
class AdapterRecord(AdapterOrigin):
    """`base.json` in an adapter's folder."""

    base: BaseHashes
    tensors: str
    """SHA-256 of the file of the adapter's own tensors."""


_CARD = """---
library_name: peft
tags:
- lora
- novel-view-synthesis
---
# An adapter for one scene

Low-rank additions to the denoiser of a view-extrapolation model, trained on photographs of one
scene alone. It paints new views of that scene; other scenes may come out worse than without it.

| | |
|---|---|
{rows}

`base.json` says the same for programs. The adapter is refused on other weights than these.

## Use

```bash
python -m extrap_train task=view category=NAME {command} orbit=360 adapter=FOLDER
```

```python
from extrap_train.tasks.view import open_generator

generator = open_generator({weights!r}, adapter="FOLDER")
```

Any `category` will do. In plain peft: `PeftModel.from_pretrained(unet, "FOLDER")`.
"""


def model_card(record: AdapterRecord) -> str:
    """The `README.md` of an adapter's folder."""
    rows = {
        "scene": f"`{record.scene}`",
        "photographs": ", ".join(f"`{name}`" for name in record.photographs),
        "weights": f"`{record.weights}`",
        "SHA-256 of the denoiser": f"`{record.base.denoiser}`",
        "SHA-256 of its other networks": f"`{record.base.others}`",
        "training": record.outcome,
        "options": ", ".join(f"`{name}={value}`" for name, value in record.options.items()),
    }
    options = {
        "weights": record.weights,
        "scene": record.scene,
        "input_frames": f"[{','.join(record.photographs)}]",
    }
    return _CARD.format(
        rows="\n".join(f"| {name} | {value} |" for name, value in rows.items()),
        command=" ".join(shlex.quote(f"{name}={value}") for name, value in options.items()),
        weights=record.weights,
    )
