"""Print where the tip of the index finger is, with nothing of Phalanx installed: pip install eclipse-zenoh msgspec.

Beside a master: python docs/examples/subscriber.py [tcp/127.0.0.1:47802]. Fields: docs/wire.md, with keys: docs/keys.md
"""

import json
import struct
import sys

import msgspec
import zenoh

END = sys.argv[1] if len(sys.argv) > 1 else "tcp/127.0.0.1:47802"
SETTINGS = {"mode": "client", "connect": {"endpoints": [END]}, "scouting": {"multicast": {"enabled": False}}}
with zenoh.open(zenoh.Config.from_json5(json.dumps(SETTINGS))) as session:
    hands = session.declare_subscriber("phalanx/hand/*")  # kept in a name: without one it would end at once
    for sample in hands:
        hand = msgspec.msgpack.decode(sample.payload.to_bytes())
        x, y, z = struct.unpack_from("<3d", hand["position_m"], 10 * 24)  # joint 10 of docs/frames.md
        print(f"{hand['hand']} {hand['t_ns'] * 1e-9:.3f} s: {x:.4f} {y:.4f} {z:.4f} m", flush=True)  # noqa: T201
