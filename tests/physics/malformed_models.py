"""Broken MJCF, one fault each, and what the error must name."""

GEOM = '<geom name="ball" type="sphere" size="0.1"/>'


def world(inside: str, rest: str = "") -> str:
    return (
        f'<mujoco model="broken">\n  <worldbody>\n    {inside}\n  </worldbody>\n  {rest}\n</mujoco>'
    )


def body(inside: str, rest: str = "", attributes: str = "") -> str:
    return world(f'<body name="link" {attributes}>\n      {inside}\n    </body>', rest)


JOINTED = f'<joint name="hinge"/>{GEOM}'

# name: (XML, what the message must contain)
MALFORMED: dict[str, tuple[str, tuple[str, ...]]] = {
    # not XML, or not MJCF
    "no closing tag": ('<mujoco model="broken">\n  <worldbody>', ("not well-formed", "line")),
    "crossed tags": ("<mujoco><worldbody></mujoco></worldbody>", ("not well-formed",)),
    "attribute without quotes": (
        "<mujoco>\n  <option timestep=0.1/>\n</mujoco>",
        ("not well-formed", "timestep=0.1"),
    ),
    "another root": ("<robot_description/>", ("robot_description",)),
    "only a comment": ("<!-- nothing -->", ()),
    # schema
    "unknown element": (world(f"<bdy>{GEOM}</bdy>"), ("bdy", "line 3")),
    "unknown attribute": (
        world('<geom name="ball" type="sphere" radius="0.1"/>'),
        ("radius", "geom", "line 3"),
    ),
    "unknown geom type": (
        world('<geom name="ball" type="spher" size="1"/>'),
        ("spher", "geom", "line 3"),
    ),
    "unknown joint type": (
        body(f'<joint name="hinge" type="hing"/>{GEOM}'),
        ("hing", "joint", "line 4"),
    ),
    "unknown integrator": (
        '<mujoco>\n  <option integrator="rk5"/>\n</mujoco>',
        ("rk5", "option", "line 2"),
    ),
    "unknown flag": (
        '<mujoco>\n  <option><flag contacts="disable"/></option>\n</mujoco>',
        ("contacts", "flag"),
    ),
    "unknown sensor": (
        body(JOINTED, '<sensor><jointposition joint="hinge"/></sensor>'),
        ("jointposition",),
    ),
    "repeated default class": (
        '<mujoco><default><default class="a"/><default class="a"/></default></mujoco>',
        ("a", "default"),
    ),
    "unknown default class": (world('<geom class="steel" size="1"/>'), ("steel", "geom")),
    # numbers
    "too few numbers": (body(GEOM, attributes='pos="0 0"'), ("pos", "body", "line 3")),
    "too many numbers": (body(GEOM, attributes='pos="0 0 0 0"'), ("pos", "body", "line 3")),
    "a word for a number": (body(GEOM, attributes='pos="0 0 high"'), ("pos", "body", "line 3")),
    "a number too large": (body(GEOM, attributes='pos="1e400 0 0"'), ("pos", "body", "line 3")),
    "zero quaternion": (body(GEOM, attributes='quat="0 0 0 0"'), ("quaternion", "body", "line 3")),
    "two orientations": (body(GEOM, attributes='quat="1 0 0 0" euler="0 0 0"'), ("body", "line 3")),
    "zero size": (world('<geom name="ball" type="sphere" size="0"/>'), ("size", "ball", "line 3")),
    "negative size": (
        world('<geom name="ball" type="sphere" size="-1"/>'),
        ("size", "ball", "line 3"),
    ),
    "no size": (world('<geom name="ball" type="box"/>'), ("size", "ball", "line 3")),
    "zero axis": (body(f'<joint name="hinge" axis="0 0 0"/>{GEOM}'), ("axis", "hinge", "line 4")),
    "range upside down": (
        body(f'<joint name="hinge" limited="true" range="1 -1"/>{GEOM}'),
        ("range", "hinge", "line 4"),
    ),
    "negative mass": (world('<body name="link"><geom size="1" mass="-1"/></body>'), ("mass",)),
    "negative armature": (body(f'<joint name="hinge" armature="-1"/>{GEOM}'), ("inertia", "hinge")),
    "impossible inertia": (
        body(f'<joint/><inertial pos="0 0 0" mass="1" diaginertia="1 1 9"/>{GEOM}'),
        ("inertia", "link"),
    ),
    # not finite: MuJoCo only warns
    "timestep nan": (
        '<mujoco>\n  <option timestep="nan"/>\n</mujoco>',
        ("option.timestep", "nan", "<option>"),
    ),
    "gravity nan": (
        '<mujoco>\n  <option gravity="0 0 nan"/>\n</mujoco>',
        ("option.gravity", "nan"),
    ),
    "mass nan": (body('<joint name="hinge"/><geom size="0.1" mass="nan"/>'), ("nan", "line 4")),
    "position nan": (
        body(f"<freejoint/>{GEOM}", attributes='pos="0 nan 0"'),
        ("body_pos", "nan", "link"),
    ),
    "friction nan": (
        world('<geom name="ball" size="1" friction="nan 0 0"/>'),
        ("geom_friction", "ball"),
    ),
    "damping nan": (body(f'<joint name="hinge" damping="nan"/>{GEOM}'), ("dof_damping", "hinge")),
    "gain nan": (
        body(JOINTED, '<actuator><general name="push" joint="hinge" gainprm="nan"/></actuator>'),
        ("actuator_gainprm", "push"),
    ),
    "keyframe nan": (
        body(JOINTED, '<keyframe><key name="home" qpos="nan"/></keyframe>'),
        ("key_qpos", "home"),
    ),
    "site nan": (world('<site name="tip" pos="nan 0 0"/>'), ("site_pos", "tip")),
    "stiffness beyond float32": (
        body(f'<joint name="hinge" stiffness="1e39"/>{GEOM}'),
        ("jnt_stiffness", "1e+39", "hinge"),
    ),
    "mass beyond float32": (body('<joint/><geom size="0.1" mass="1e39"/>'), ("body_mass", "link")),
    # names and references
    "repeated body": (world(f'<body name="a">{GEOM}</body><body name="a"/>'), ("'a'", "body")),
    "repeated joint": (
        body(f'<joint name="hinge"/><joint name="hinge" axis="1 0 0"/>{GEOM}'),
        ("hinge", "joint"),
    ),
    "actuator on nothing": (body(JOINTED, '<actuator><motor name="push"/></actuator>'), ("push",)),
    "actuator on unknown joint": (
        body(JOINTED, '<actuator><motor name="push" joint="hing"/></actuator>'),
        ("hing", "push"),
    ),
    "sensor on unknown site": (
        body(JOINTED, '<sensor><gyro name="imu" site="chip"/></sensor>'),
        ("chip", "imu"),
    ),
    "tendon on unknown joint": (
        body(JOINTED, '<tendon><fixed name="rope"><joint joint="hing" coef="1"/></fixed></tendon>'),
        ("hing", "rope"),
    ),
    "equality with unknown body": (
        body(JOINTED, '<equality><connect name="pin" body1="lnk" anchor="0 0 0"/></equality>'),
        ("lnk", "pin"),
    ),
    "exclude of unknown body": (
        body(JOINTED, '<contact><exclude body1="lnk" body2="link"/></contact>'),
        ("lnk",),
    ),
    "unknown material": (world('<geom name="ball" size="1" material="gold"/>'), ("gold", "ball")),
    "unknown mesh": (world('<geom name="ball" type="mesh" mesh="teapot"/>'), ("teapot", "ball")),
    "keyframe of another length": (
        body(JOINTED, '<keyframe><key name="home" qpos="0 0 0"/></keyframe>'),
        ("qpos", "home"),
    ),
    # structure
    "no mass": (world('<body name="link"><freejoint/></body>'), ("mass", "link", "line 3")),
    "free joint below the world": (
        body(f'{GEOM}<body name="child"><freejoint name="loose"/><geom size="0.1"/></body>'),
        ("free joint", "child"),
    ),
    "two free joints": (body(f'<freejoint name="a"/><freejoint name="b"/>{GEOM}'), ("link",)),
    "free joint with another": (body(f'<freejoint name="a"/><joint name="b"/>{GEOM}'), ("link",)),
    "joint in the world": (world('<joint name="hinge"/>'), ("joint", "line 3")),
    "plane that moves": (
        body('<joint name="hinge"/><geom name="floor" type="plane" size="1 1 1"/>'),
        (),
    ),
    "empty tendon": (world("", '<tendon><spatial name="rope"/></tendon>'), ("rope",)),
    "weld of two bodies on one": (
        body(JOINTED, '<equality><weld name="glue" body1="link" body2="link"/></equality>'),
        ("glue",),
    ),
    # files
    "missing mesh file": (
        '<mujoco>\n  <asset>\n    <mesh name="teapot" file="teapot.stl"/>\n  </asset>\n</mujoco>',
        ("teapot.stl", "line 3"),
    ),
    "missing include": (
        '<mujoco>\n  <include file="robot.xml"/>\n</mujoco>',
        ("robot.xml", "include", "line 2"),
    ),
    "missing texture file": (
        '<mujoco>\n  <asset>\n    <texture name="wood" type="2d" file="wood.png"/>\n  </asset>\n</mujoco>',
        ("wood.png", "line 3"),
    ),
    # features that MuJoCo has and Warp has not
    "solver pgs": ('<mujoco>\n  <option solver="PGS"/>\n</mujoco>', ("PGS", "supported")),
    "flag of a missing feature": (
        '<mujoco>\n  <option><flag fwdinv="enable"/></option>\n</mujoco>',
        ("mjENBL_FWDINV", "<option>", "supported"),
    ),
}
