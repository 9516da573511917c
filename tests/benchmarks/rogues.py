"""Methods that do what no method should, by name: what each does before it returns, and what must
become of its row: a status, or for a failure a part of its reason.
"""

from pathlib import Path

STATE = {
    "default_dtype": "torch.set_default_dtype(torch.float64)",
    "grad_mode": "torch.set_grad_enabled(False)",
    "threads": "torch.set_num_threads(64)",
    "deterministic": "torch.use_deterministic_algorithms(True)",
    "default_device": "torch.set_default_device('meta')",
    "random_state": "random.seed(7); np.random.seed(7); torch.manual_seed(7)",
    "chdir": "os.chdir(tempfile.mkdtemp())",
    "environment": "os.environ.clear()",
    "cuda_visible": "os.environ['CUDA_VISIBLE_DEVICES'] = '0'",
    "path": "sys.path.clear()",
    "modules": "[sys.modules.pop(m) for m in list(sys.modules) if m.startswith('benchmarks')]",
    "warnings": "warnings.simplefilter('error')",
    "signals": "[signal.signal(s, signal.SIG_IGN) for s in (2, 15, 1)]",
    "umask": "os.umask(0o777)",
    "nice": "os.nice(5)",
    "no_gc": "gc.disable(); gc.freeze()",
    "trace": "sys.settrace(lambda *_: None)",
    "recursion": "sys.setrecursionlimit(10**6)",
    "print": "builtins.print = None",
    "open": "builtins.open = None",
    "excepthook": "sys.excepthook = None; threading.excepthook = None",
    "stdout": "sys.stdout.close(); sys.stderr.close()",
    "descriptors": "os.close(1); os.close(2)",
    "exit_handler": "atexit.register(time.sleep, 3000)",
    "patched": "torch.full = np.save = None",
    "unclean": "print('\\x1b[2J' + 'x' * 100_000, flush=True)",
}
LEFTOVERS = {
    "thread": "threading.Thread(target=time.sleep, args=(3000,)).start()",
    "daemon_thread": "threading.Thread(target=time.sleep, args=(3000,), daemon=True).start()",
    "child": "subprocess.Popen(['sleep', '3000'])",
    "session": "subprocess.Popen(['sleep', '3000'], start_new_session=True)",
    "orphan": "subprocess.Popen(['sh', '-c', 'sleep 3000 & exit'], start_new_session=True).wait()",
    "fork": "os.fork()",
    "forked_sleeper": "os.fork() or time.sleep(3000)",
    "interrupts_parent": "os.kill(os.getppid(), signal.SIGINT)",
    "ends_parent": "os.kill(os.getppid(), signal.SIGTERM)",
    "hangs_parent_up": "os.kill(os.getppid(), signal.SIGHUP)",
}
SOUND = {
    "float64": "made['images'] = images.double()",
    "half": "made['images'] = images.half()",
    "grad": "made['images'] = images.requires_grad_()",
    "strided": "made['images'] = images.expand(2, *images.shape)[1].flip(-1)",
    "points": "made['points'] = torch.zeros(5, 3)",
    "no_points": "made['points'] = torch.zeros(0, 3)",
    "float_count": "made['counts'] = {'gaussians': np.float64(3)}",
}
ENDS = {
    "raise": ("raise RuntimeError('no luck')", "RuntimeError: no luck"),
    "exit": ("sys.exit(0)", "SystemExit"),
    "exit_text": ("sys.exit('bye')", "SystemExit: bye"),
    "exit_now": ("os._exit(0)", "exit status 0"),
    "exit_seven": ("os._exit(7)", "exit status 7"),
    "exit_255": ("os._exit(255)", "killed"),
    "kill": ("os.kill(os.getpid(), 9)", "killed"),
    "kill_group": ("os.kill(0, 9)", "killed"),
    "kill_parent": ("os.kill(os.getppid(), 9); time.sleep(3000)", "killed"),
    "terminate": ("os.kill(os.getpid(), 15)", "SIGTERM"),
    "abort": ("os.abort()", "SIGABRT"),
    "segfault": ("ctypes.string_at(0)", "SIGSEGV"),
    "alarm": ("signal.alarm(1); time.sleep(3000)", "SIGALRM"),
    "interrupt": ("raise KeyboardInterrupt", "KeyboardInterrupt"),
    "interrupt_self": ("os.kill(os.getpid(), 2); time.sleep(30)", "KeyboardInterrupt"),
    "generator": ("raise GeneratorExit", "GeneratorExit"),
    "stop": ("raise StopIteration", "StopIteration"),
    "memory": ("raise MemoryError('too large')", "MemoryError: too large"),
    "too_large": ("np.ones(10**14)", "MemoryError"),
    "recurse": ("f = lambda: f(); f()", "RecursionError"),
    "import": ("import nowhere_at_all", "ModuleNotFoundError"),
    "bad_text": ("raise FileNotFoundError('caf\\udce9.png')", "FileNotFoundError: caf"),
    "long_text": ("raise ValueError('x' * 10**7)", "ValueError: xxx"),
    "control_text": ("raise ValueError('a\\n\\x1b[2J\\x00b')", "ValueError: a"),
    "script_text": ("raise ValueError('<script>|$\\\\input{x}')", "ValueError: <script>"),
    "no_text": ("raise type('E', (Exception,), {'__str__': lambda s: 1 / 0})()", "exit status 1"),
    "closed_files": ("os.closerange(3, 512)", "exit status 1"),
    "file_limit": ("resource.setrlimit(resource.RLIMIT_FSIZE, (0, 0))", "exit status 1"),
    "forged": (
        "[os.write(f, b'x' * 99) for f in range(3, 64) if is_file(f)]; os._exit(0)",
        "returned no result",
    ),
    "forged_pickle": (
        "[os.write(f, b'\\x80\\x04cos\\nabort\\n(tR.') for f in range(3, 64) if is_file(f)]; "
        "os._exit(0)",
        "returned no result",
    ),
    "huge": ("made['points'] = torch.zeros(6_000_000, 3)", "points must be"),
    "none": ("returned.append(None)", "AttributeError"),
    "mapping": ("returned.append({})", "AttributeError"),
    "images_list": ("made['images'] = [0.5]", "images must be a tensor"),
    "images_array": ("made['images'] = images.numpy()", "images must be a tensor"),
    "images_bytes": ("made['images'] = (255 * images).byte()", "images must be a tensor"),
    "images_complex": ("made['images'] = images.to(torch.complex64)", "images must be a tensor"),
    "images_few": ("made['images'] = images[1:]", "made images"),
    "images_small": ("made['images'] = images[..., 1:]", "made images"),
    "images_last": ("made['images'] = images.permute(0, 2, 3, 1)", "made images"),
    "images_flat": ("made['images'] = images[0]", "RuntimeError"),
    "images_none": ("made['images'] = images[:0]", "Error"),
    "images_nan": ("images[0, 0, 0, 0] = torch.nan", "images in [0, 1]"),
    "images_bright": ("images += 1.1", "images in [0, 1]"),
    "images_signed": ("images -= 1", "images in [0, 1]"),
    "images_meta": ("made['images'] = images.to('meta')", "Error"),
    "images_sparse": ("made['images'] = images.to_sparse()", "Error"),
    "points_flat": ("made['points'] = torch.zeros(6)", "points are"),
    "points_nan": ("made['points'] = torch.full((2, 3), torch.nan)", "points must be"),
    "points_infinite": ("made['points'] = torch.full((2, 3), torch.inf)", "points must be"),
    "points_whole": ("made['points'] = torch.zeros(2, 3).long()", "points must be a tensor"),
    "points_list": ("made['points'] = [[0.0] * 3]", "points must be a tensor"),
    "seconds_nan": ("made['seconds'] = float('nan')", "seconds"),
    "seconds_infinite": ("made['seconds'] = float('inf')", "seconds"),
    "seconds_negative": ("made['seconds'] = -5.0", "seconds"),
    "seconds_text": ("made['seconds'] = 'fast'", "TypeError"),
    "seconds_none": ("made['seconds'] = None", "TypeError"),
    "seconds_tensor": ("made['seconds'] = torch.tensor(1.0)", "seconds"),
    "given_list": ("made['given'] = ['a']", "Error"),
    "given_number": ("made['given'] = {'init': 3}", "given.init"),
    "given_surrogate": ("made['given'] = {'init': '\\ud800'}", "surrogate"),
    "given_many": ("made['given'] = {str(i): 'x' for i in range(1000)}", "entries"),
    "count_float32": ("made['counts'] = {'n': np.float32(3)}", "float32"),
    "count_nan": ("made['counts'] = {'n': float('nan')}", "counts.n"),
    "count_nested": ("made['counts'] = {'n': {}}", "counts.n"),
    "count_true": ("made['counts'] = {'n': True}", "counts.n"),
}
HANGS = {
    "sleep": "time.sleep(3000)",
    "loop": "while True: pass",
    "deaf": "[signal.signal(s, signal.SIG_IGN) for s in (1, 2, 15)]; time.sleep(3000)",
    "lock": "lock = threading.Lock(); lock.acquire(); lock.acquire()",
    "stopped": "os.kill(os.getpid(), signal.SIGSTOP)",
    "stops_parent": "os.kill(os.getppid(), signal.SIGSTOP); time.sleep(3000)",
    "waits_for_child": "subprocess.run(['sleep', '3000'])",
}

BEFORE = {
    "import_raise": ("1 / 0", "return ()", "ZeroDivisionError"),
    "import_exit": ("import sys; sys.exit(0)", "return ()", "SystemExit"),
    "import_patch": ("import benchmarks.score.scoring as s; s.psnr = None", "return ()", ""),
    "weights_raise": ("", "1 / 0", "ZeroDivisionError"),
    "weights_exit": ("", "import sys; sys.exit(0)", "SystemExit"),
    "weights_none": ("", "return None", "TypeError"),
    "weights_kill": ("", "import os; os._exit(0)", "exit status 0"),
    "weights_text": ("", "return [__file__]", ""),
}
"""By name: what the module does when it is imported, what `weight_files` does, and what must become
of the row: a part of the reason, or nothing where it is sound.
"""
_MODULE = """
import torch
from benchmarks.methods.base import Synthesis
{imported}


class Rogue:
    def weight_files(self, category):
        {weights}

    def synthesize(self, inputs):
        count = len(inputs.targets.world_to_cam)
        return Synthesis(torch.zeros(count, 3, inputs.targets.height, inputs.targets.width), 0.1)
"""

_METHOD = """
import atexit, builtins, ctypes, gc, os, random, resource, signal, stat, subprocess, sys, tempfile
import threading, time, warnings
from dataclasses import dataclass

import numpy as np
import torch

from benchmarks.methods.base import Synthesis

ACTS = {acts!r}


def is_file(descriptor):
    try:
        return stat.S_ISREG(os.fstat(descriptor).st_mode) and descriptor > 2
    except OSError:
        return False


@dataclass(frozen=True)
class Rogue:
    act: str = ""

    def weight_files(self, category):
        return ()

    def synthesize(self, inputs):
        count = len(inputs.targets.world_to_cam)
        size = (inputs.targets.height, inputs.targets.width)
        images = torch.rand(count, 3, *size) * float(np.random.uniform()) * random.random()
        made = {{"images": images, "seconds": 0.1}}
        scope = {{**globals(), "images": images, "made": made, "returned": (returned := [])}}
        exec(ACTS[self.act], scope)
        return returned[0] if returned else Synthesis(**made)
"""
_TABLE = """
captures: {source: synthetic, categories: [apple], sequences: 1, frames: 10, render_size: 24}
rules: {image_size: 24, views: [3], draws: [random]}
methods: [honest]
columns: [psnr, masked_psnr, seconds]
scoring: {dists: false, lpips: []}
"""


def acts() -> dict[str, str]:
    """Every name with the code of what it does; `honest` does nothing."""
    ends = {name: act for name, (act, _) in ENDS.items()}
    return {"honest": "", **STATE, **LEFTOVERS, **SOUND, **ends, **HANGS}


def write_rogues(folder: Path) -> Path:
    """The folder that `--config-dir` takes: a table `rogues`, and a method per name."""
    (folder / "method").mkdir(parents=True)
    (folder / "table").mkdir()
    (folder / "rogue_method.py").write_text(_METHOD.format(acts=acts()))
    for name in acts():
        text = f"factory: rogue_method.Rogue\noptions: {{act: {name}}}\n"
        (folder / "method" / f"{name}.yaml").write_text(text)
    for name, (imported, weights, _) in BEFORE.items():
        module = _MODULE.format(imported=imported, weights=weights)
        (folder / f"{name}_module.py").write_text(module)
        (folder / "method" / f"{name}.yaml").write_text(f"factory: {name}_module.Rogue\n")
    (folder / "table" / "rogues.yaml").write_text(_TABLE)
    return folder
