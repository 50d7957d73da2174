import subprocess
import sys


def test_the_distributions_need_torch_alone():
    # Gymnasium takes a tenth of a second: the package registers its environments there.
    code = "import sys, torchrl_mcp.distributions; print([m for m in sys.argv[1:] if m in sys.modules])"
    heavy = ["torchrl", "tensordict", "mujoco", "hydra"]
    run = subprocess.run([sys.executable, "-c", code, *heavy], capture_output=True, text=True, check=True)
    assert run.stdout.strip() == "[]"
