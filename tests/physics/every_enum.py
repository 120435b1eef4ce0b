"""Every field of mjOption and every value of MuJoCo's enums; test_every_option.py compares the lists with MuJoCo."""

JUDGE = "tests/benchmarks/judge/test_generated.py::test_a_model_is_as_in_c"
RARE = "tests/benchmarks/judge/test_rare_models.py::test_a_rare_model_is_as_in_c"
ASLEEP = "tests/physics/test_asleep.py::test_trees_fall_asleep_as_in_c"
FIELDS = "tests/physics/test_every_field.py::test_each_field_has_its_effect"

# Fields of mjOption, by the test that shows that they are as in C.
OPTIONS_HONOURED = {
    JUDGE: (
        "cone density disableactuator disableflags enableflags gravity impratio integrator jacobian magnetic timestep "
        "viscosity wind noslip_iterations"
    ),
    RARE: "ccd_iterations ccd_tolerance sdf_initpoints sdf_iterations noslip_tolerance",
    ASLEEP: "sleep_tolerance",
    # Settings of the solver, which end sooner or later at the same forces.
    "tests/physics/test_sim_cfg.py": "iterations ls_iterations ls_tolerance tolerance solver",
}
OPTIONS_REFUSED = {"override": "o_friction o_margin o_solimp o_solref"}

# Values of enums, by enum and test.
HONOURED = {
    "mjtJoint": {JUDGE: "FREE BALL SLIDE HINGE"},
    "mjtGeom": {
        JUDGE: "PLANE SPHERE CAPSULE ELLIPSOID CYLINDER BOX MESH",
        "tests/physics/test_height_fields.py": "HFIELD",
        RARE: "SDF",
    },
    "mjtTrn": {JUDGE: "JOINT JOINTINPARENT SLIDERCRANK TENDON SITE BODY"},
    "mjtDyn": {JUDGE: "NONE INTEGRATOR FILTER FILTEREXACT MUSCLE DCMOTOR"},
    "mjtGain": {JUDGE: "FIXED AFFINE MUSCLE DCMOTOR"},
    "mjtBias": {JUDGE: "NONE AFFINE MUSCLE DCMOTOR"},
    "mjtEq": {JUDGE: "CONNECT WELD JOINT TENDON", RARE: "FLEX FLEXSTRAIN"},
    "mjtWrap": {JUDGE: "JOINT PULLEY SITE SPHERE CYLINDER"},
    "mjtSensor": {
        JUDGE: (
            "TOUCH ACCELEROMETER VELOCIMETER GYRO FORCE TORQUE MAGNETOMETER RANGEFINDER CAMPROJECTION JOINTPOS "
            "JOINTVEL TENDONPOS TENDONVEL ACTUATORPOS ACTUATORVEL ACTUATORFRC JOINTACTFRC TENDONACTFRC BALLQUAT "
            "BALLANGVEL JOINTLIMITPOS JOINTLIMITVEL JOINTLIMITFRC TENDONLIMITPOS TENDONLIMITVEL TENDONLIMITFRC "
            "FRAMEPOS FRAMEQUAT FRAMEXAXIS FRAMEYAXIS FRAMEZAXIS FRAMELINVEL FRAMEANGVEL FRAMELINACC FRAMEANGACC "
            "SUBTREECOM SUBTREELINVEL SUBTREEANGMOM INSIDESITE GEOMDIST GEOMNORMAL GEOMFROMTO CONTACT E_POTENTIAL "
            "E_KINETIC CLOCK"
        ),
        RARE: "TACTILE USER",
    },
    "mjtIntegrator": {JUDGE: "EULER RK4 IMPLICIT IMPLICITFAST DISCRETE"},
    "mjtCone": {JUDGE: "PYRAMIDAL ELLIPTIC"},
    "mjtSolver": {JUDGE: "NEWTON", "tests/physics/test_sim_cfg.py": "CG"},
    "mjtJacobian": {JUDGE: "DENSE SPARSE AUTO"},
    "mjtDisableBit": {
        JUDGE: (
            "CONSTRAINT EQUALITY FRICTIONLOSS LIMIT CONTACT SPRING DAMPER GRAVITY CLAMPCTRL WARMSTART FILTERPARENT "
            "ACTUATION REFSAFE SENSOR EULERDAMP NATIVECCD ISLAND MULTICCD"
        )
    },
    "mjtEnableBit": {JUDGE: "ENERGY INVDISCRETE SLEEP"},
    "mjtCamLight": {JUDGE: "FIXED TRACK TRACKCOM", RARE: "TARGETBODY TARGETBODYCOM"},
    "mjtConDataField": {JUDGE: "FOUND FORCE TORQUE DIST POS NORMAL TANGENT", RARE: "LINVEL ANGVEL"},
    "mjtSleepPolicy": {ASLEEP: "AUTO_NEVER AUTO_ALLOWED"},
}
# Each is shown by a model of the same name in test_every_option.py.
REFUSED = {
    "mjtGeom": "",
    "mjtTrn": "SO3",
    "mjtDyn": "PID USER",
    "mjtGain": "SO3 PID USER",
    "mjtBias": "SO3 USER",
    "mjtEq": "FLEXVERT DISTANCE",
    "mjtSensor": "PLUGIN",
    "mjtSolver": "PGS",
    "mjtDisableBit": "MIDPHASE AUTORESET",
    "mjtEnableBit": "OVERRIDE FWDINV DIAGEXACT SPECULATIVE IPC",
    "mjtSleepPolicy": "NEVER ALLOWED INIT",
}
WITHOUT_MEANING = {
    # Counts, marks of pictures, and what no compiled model has.
    "mjtGeom": "ARROW ARROW1 ARROW2 LINE LINEBOX FLEX SKIN LABEL TRIANGLE NONE",
    "mjtTrn": "UNDEFINED",
    "mjtWrap": "NONE",
    # The compiler takes one of the other two instead.
    "mjtSleepPolicy": "AUTO",
}
