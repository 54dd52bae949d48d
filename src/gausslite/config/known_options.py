"""Names of the options of all of GaussLite's programs; a test compares them with the programs.

A program needs them to recognise variables that set options of other programs.
"""

from typing import Final

KNOWN_OPTIONS: Final = frozenset(
    {
        *("agents", "corpus", "held", "hostile", "kills", "messages", "seconds", "server", "servers", "watchers"),
        *("absent", "accept-similar", "after", "agent-id", "backend", "before", "blur", "camera-correction", "caps"),
        "changes",
        *("traces", "deadline-slack", "details", "detector", "disable", "drain-timeout", "equal", "exit-when-done"),
        *("frame-alignment", "frame-error", "free-space", "homes", "late-joiner", "positions", "team-map"),
        *("external-rasterizer", "fit-views", "frames", "frames-a", "frames-b", "fusion", "gaussians"),
        *(
            "grace-period",
            "handover",
            "health",
            "idle-iterations",
            "iterations",
            "json",
            "keyframes",
            "kinds",
            "listen",
            "llm-format",
        ),
        *("limit-calls", "limit-connections", "limit-idle", "limit-kbps", "log-format", "metrics"),
        *("fused-from-agent", "lens", "shutter", "speeds", "team-sizes", "vote"),
        *("llm-key-variable", "llm-model", "llm-timeout", "llm-url", "loop", "lpips-weights", "map", "masks"),
        *(
            "max-gaussians",
            "max-missions",
            "max-shown",
            "min-iterations",
            "mission",
            "objects",
            "out",
            "overwrite",
            "pair",
            "pairs",
        ),
        *(
            "parser",
            "perception",
            "pictures",
            "policies",
            "policy",
            "pose-prior",
            "poses",
            "present",
            "preset",
            "queue",
        ),
        *("queue-policy", "quota-agents", "quota-gaussians", "quota-keyframe-pixels", "quota-keyframes"),
        *(
            "quota-voxels",
            "rasterizer",
            "rate",
            "ray-address",
            "real",
            "recorded-size",
            "refine-iterations",
            "register-depth",
            "reps",
        ),
        *(
            "resegment",
            "resume",
            "reuse-other-code",
            "roi",
            "roi-ball",
            "save-interval",
            "save-state",
            "seed",
            "seeds",
            "shards",
        ),
        *("save-scores", "segmenter", "sentences", "shares", "simd", "size", "sizes", "skip-stages", "source", "spool"),
        *("state", "store", "store-max-mb", "strict", "task", "task-a", "task-at", "task-b", "test-every"),
        *("threads", "timed", "tls-ca", "tls-cert", "tls-key", "track-motion", "unlimited", "up", "uplink-interval"),
        *("uplink-kbps", "view", "views", "vocabulary", "voxel-size", "world-frame"),
    }
)
