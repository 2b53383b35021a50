"""``yardstick inspect``: the content of a file, and an exit code for what is suspicious."""

import base64
import json
import pickle
import zipfile

import gymnasium as gym

from tests.pipeline.short_runs import CART, agent_of


def test_content_and_suspicion(type_command):
    agent_of("a2c", gym.make(CART)).save("fine.zip")
    call = {":type:": "Call", ":serialized:": base64.b64encode(pickle.dumps(print)).decode()}
    with zipfile.ZipFile("fine.zip") as fine, zipfile.ZipFile("strange.zip", "w") as strange:
        for name in fine.namelist():
            content = fine.read(name)
            if name == "data":
                content = json.dumps({**json.loads(content), "lr_schedule": call})
            strange.writestr(name, content)
    code, out, err = type_command("yardstick", "inspect", "fine.zip")
    assert (code, err) == (0, "")
    assert out.startswith("members\n")
    assert out.endswith("nothing in it is suspicious\n")
    code, out, err = type_command("yardstick", "inspect", "strange.zip")
    assert (code, err) == (1, "")
    assert "lr_schedule" in out[out.index("\nsuspicious\n") :]


def test_what_is_no_model_ends_in_one_line(type_command, tmp_path):
    (tmp_path / "text.zip").write_text("no zip")
    for name, said in {"text.zip": "is no model", "none.zip": "no such model file"}.items():
        code, out, err = type_command("yardstick", "inspect", name)
        assert (code, out, err.count("\n")) == (2, "", 1)
        assert said in err
