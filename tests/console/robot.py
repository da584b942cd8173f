"""A program that streams poses to the demo scene, as it is told on its standard input.

`x Y`: a pose with its place at Y mm along the scene's x.
`run HZ`: a pose along y, HZ times a second, until the next line.
Each answer is told as a line: the sequence and the x that was rendered.
"""

import json
import select
import struct
import sys

from websockets.sync.client import connect

address, settings = sys.argv[1], json.loads(sys.argv[2])
pose = {"position_mm": {"x": 0.0, "y": 0.0, "z": 0.0}, "quaternion": {"w": 1, "x": 0, "y": 0, "z": 0}}


def tell(*facts):
    sys.stdout.write(" ".join(map(str, facts)) + "\n")
    sys.stdout.flush()


def ask(stream, sequence):
    message = {"sequence": sequence, "mode": "latest", "pose": pose}
    if sequence == 0:
        message["settings"] = settings
    stream.send(json.dumps(message))
    answer = stream.recv()
    if isinstance(answer, str):
        tell("refused", answer)
        return
    (length,) = struct.unpack_from("<I", answer)
    header = json.loads(answer[4 : 4 + length])
    tell(header["sequence"], header["pose"][0][3])


with connect(address, max_size=None) as stream:
    sequence, period_s = 0, None
    ask(stream, sequence)
    while True:
        if select.select([sys.stdin], [], [], period_s)[0]:
            line = sys.stdin.readline()
            if not line:
                break
            command, value = line.split()
            period_s = 1 / float(value) if command == "run" else None
            if command == "x":
                pose["position_mm"]["x"] = float(value)
        else:
            pose["position_mm"]["y"] = 10 * ((sequence / 40) % 1)
        sequence += 1
        ask(stream, sequence)
