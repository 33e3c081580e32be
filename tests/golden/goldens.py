"""The goldens: which commands and calls hold the contract, and with which inputs.

Inputs lie in inputs/ (made once with a fixed seed: `campaign` is the small campaign of
tests/fuzz/campaign.py, `june` its arm half a year later, `arm` two arms with drawn errors,
`whole` a simulated arm with everything, of experiment_design/blind_diagnosis) or where the
documentation has them.
"""

from __future__ import annotations

from golden import door, mistakes, mistakes_design
from golden.runner import Golden

TUTORIAL = ("docs/tutorial",)
BLIND = ("experiment_design/blind_diagnosis/example",)
CAMPAIGN = ("tests/golden/inputs/campaign",)
ARM = ("tests/golden/inputs/arm",)
WHOLE = ("tests/golden/inputs/whole",)


def case(name: str) -> tuple[str, ...]:
    return (f"tests/cases/{name}",)


TRUTH = " ".join(
    f"--set joint{i}.compliance={value}"
    for i, value in enumerate(("1.8e-6", "2.1e-6", "3.4e-6", "1.2e-5", "1.5e-5", "2.2e-5"), 1)
)
MEASURED = f"simulate cell.toml {{}}.csv -o {{}}.csv --seed {{}} --load {{}} --repeats 3 {TRUTH}"
DOWN = "0 0 -98"
PLACED = "identify placed.toml placed.csv -q"
CURVED = "identify curved.toml curved.csv -q"
DEFLECTED = "identify deflecting.toml data.csv -q"


GOLDENS: dict[str, Golden] = {
    # The whole way, as the documentation walks it
    "demo": Golden((), ("demo -q",), engine=True),
    "tutorial": Golden(TUTORIAL, (
        MEASURED.format("poses", "data", 2, DOWN),
        "identify cell.toml data.csv -o result.json -q",
        "design cell.toml -o extra.csv --poses 1 --augment data.csv --effort quick "
        "--candidates 400 -q",
        MEASURED.format("extra", "extra_data", 3, DOWN), door.append_extra,
        "identify cell.toml data.csv -q --details",
        MEASURED.format("extra", "side_data", 4, "0 60 0"), door.append_side,
        "identify cell.toml data.csv -o result.json -q --report report.html",
        "compensate cell.toml result.json targets.csv -o commands.csv -q",
        "export cell.toml result.json -o calibrated.urdf --load 0 0 -98 -q",
    ), engine=True),
    # Identification
    "identify_geometry": Golden(BLIND, (
        door.first(25),
        "identify cell.toml data.csv -o result.json -q --details --certificate done.html",
    ), engine=True),
    "identify_convention": Golden(case("fanuc_convention"), (
        "identify cell.toml train.csv --test test.csv -o result.json -q",
    ), engine=True),
    "identify_robust": Golden(CAMPAIGN, (
        door.spoil_three,
        f"{PLACED} -o auto.json",
        *(f"{PLACED} --method {method} -o {method}.json --residuals residuals.csv"
          for method in ("huber", "l1")),
        f"{PLACED} --outliers keep -o keep.json",
        f"{PLACED} --outliers drop -o drop.json",
    ), engine=True),
    "identify_methods": Golden(CAMPAIGN, (
        *(f"{PLACED} --method {method} -o {method}.json"
          for method in ("reml", "ols", "eq14", "eq14-residual")),
        door.equal_noise,
        f"{DEFLECTED} --method wls --weights covariance --covariance noise.csv -o wls.json "
        "--fix joint1",
    ), engine=True),
    "identify_noise": Golden(CAMPAIGN, (
        *(f"{PLACED} --noise {noise} -o {noise.replace('+', '_')}.json"
          for noise in ("axis", "marker", "polar", "stated", "stated+configuration")),
    ), engine=True),
    "identify_intervals": Golden(CAMPAIGN, (
        *(f"{PLACED} --method ols --intervals {kind} -o {kind}.json"
          for kind in ("classical", "hc3", "cr2", "profile")),
    ), engine=True),
    "identify_knowledge": Golden(CAMPAIGN, (
        f"{DEFLECTED} --knowledge knowledge.toml -o known.json",
        f"{DEFLECTED} --physical --method ols -o physical.json",
        f"{PLACED} --bounded -o bounded.json",
        f"{DEFLECTED} --knowledge knowledge.toml --method ols -o ols.json",
    ), engine=True),
    "identify_smooth": Golden(CAMPAIGN, (
        door.curved,
        "simulate curved.toml turns.csv -o curved.csv --seed 6 --draw 1 --load 0 0 -2000",
        f"{CURVED} -o result.json --details",
        f"{CURVED} -o ols.json --method ols",
        f"{CURVED} -o known.json --knowledge curved_knowledge.toml",
        f"{CURVED} -o profile.json --method wls --intervals profile --physical",
        f"{CURVED} --method huber",
        f"{CURVED} --intervals cr2",
        f"{CURVED} --intervals cr2 --physical",
        door.spoil_two,
        f"{CURVED} -o faulty.json",
    ), engine=True),
    "identify_limits": Golden(CAMPAIGN, (
        f"{PLACED} --test june.csv --require heldout=1e6 --require test=1e6",
        f"{PLACED} --require new_poses=0.001",
        f"{PLACED} --require test=1",
    ), engine=True),
    "identify_pose": Golden(case("pose_noise_claimed"), (
        "identify cell.toml train.csv -o result.json -q --details",
    ), engine=True),
    "identify_advice": Golden(case("rows_closed_up"), (
        "identify cell.toml train.csv -q",
    ), engine=True),
    # Diagnosis
    "diagnose_one": Golden(BLIND, (
        door.first(30),
        "diagnose cell.toml data.csv -o diagnosis.json --cell-out found.toml --report page.html -q",
    ), engine=True),
    "diagnose_many": Golden(WHOLE, (
        door.first(18),
        "diagnose cell.toml data.csv -o diagnosis.json --cell-out found.toml -q",
    ), engine=True),
    "diagnose_nothing": Golden(case("joint_zero_5deg"), (
        "diagnose cell.toml train.csv -o diagnosis.json -q",
    ), engine=True),
    "diagnose_unknown": Golden(case("without_ignored"), (
        "diagnose cell.toml train.csv -o diagnosis.json -q --without gravity_sag "
        "--without link_weights --without joint_compliance",
    ), engine=True),
    "diagnose_rivals": Golden(CAMPAIGN, (
        "diagnose placed.toml june.csv -o diagnosis.json --plan extra.csv --poses 2 -q",
    ), engine=True),
    # Planning
    "design_levels": Golden(CAMPAIGN, (
        "design planned.toml -o plan.csv --effort quick --criterion D --poses 3 --candidates 40 -q "
        "--program robot.src --program robot.script",
    ), engine=True),
    "design_criteria": Golden(CAMPAIGN, (
        "design wished.toml -o a.csv --effort quick --candidates 30 --curve 3,4 -q --criterion A",
        "design wished.toml -o d.csv --effort quick --poses 4 --candidates 40 --criterion D -q "
        "--augment data.csv",
        "design wished.toml -o k.csv --effort quick --poses 4 --candidates 40 --criterion E -q "
        "--keep poses.csv:1,3 --knowledge knowledge.toml",
    ), engine=True),
    "design_test_pose": Golden(CAMPAIGN, (
        "design planned.toml -o plan.csv --effort quick -q --fix joint1.compliance "
        "--report page.html",
    ), engine=True, tied=True),
    "next": Golden(CAMPAIGN, (
        "next wished.toml data.csv -o next.csv --batch 2 --candidates 40 --require new_poses=50 -q",
        "next wished.toml data.csv -o more.csv --batch 2 --candidates 20 -q "
        "--require new_poses=0.01",
    ), engine=True),
    # Using the calibrated arm: given results, so no engine
    "compensate": Golden(CAMPAIGN, (
        "compensate deflecting.toml result.json targets.csv -o out.csv --frame base --partial -q",
        "compensate placed.toml placed.json --target 1500,200,1200,0,90,0 --point M1 "
        "--near 0,-90,90,0,20,0 -o one.csv --json -q",
        "compensate deflecting.toml result.json --table table.csv --grid 2,2,2,1,1,1 -q",
        "compensate deflecting.toml result.json --table box.csv --grid 2,1,1 -q "
        "--box 700,-100,600,800,100,700 --rotation 0,90,0",
    )),
    "export_urdf": Golden(ARM, (
        "export urdf.toml urdf.json -o out.urdf -q --poses 20",
        "export urdf.toml urdf.json -o bare.urdf -q --poses 20 --no-frames --base-frame "
        "--load 40 -25 -120 --json",
        "export dh.toml dh.json -o from_dh.urdf -q --poses 20",
    ), engine=True),
    "export_mjcf": Golden(ARM, (
        "export urdf.toml urdf.json -o out.xml -q --poses 20 --load 0 0 -98",
        "export dh.toml dh.json -o from_dh.mjcf -q --poses 20",
    ), engine=True),
    "export_tables": Golden(ARM, (
        "export dh.toml dh.json -o out.csv -q --poses 20",
        "export dh.toml dh.json -o mdh.csv --format mdh -q --poses 20 --json",
        "export dh.toml dh.json -o out.yaml -q --poses 20",
        "export dh.toml dh.json -o out.json -q --poses 20",
        "export urdf.toml urdf.json -o urdf.csv -q --poses 20",
    ), engine=True),
    "compare": Golden(CAMPAIGN, (
        "compare placed.toml placed.json june.json -o changes.json --poses 20 -q "
        "--load 0 0 -1000",
        "compare placed.json placed.json --cell placed.toml --poses 20 -q --json",
    )),
    # Before a fit
    "simulate": Golden(CAMPAIGN, (
        "simulate deflecting.toml poses.csv -o out.csv --set joint2.compliance=2e-6 "
        "--truth truth.json --draw 0.1 --load 0 0 -98 --repeats 2 --seed 3",
        "simulate placed.toml plan270.csv -o exact.csv --no-noise --json",
    )),
    "import": Golden(CAMPAIGN, (
        "import points.txt poses.dat --map mapping.toml --cell imported.toml -o out.csv --preview",
        "import points.txt poses.dat --preset spatialanalyzer --preset kuka -o two.csv "
        "--length-unit mm --angle-unit deg --json",
        "import --show-preset kuka",
    )),
    "init": Golden(CAMPAIGN, (
        "init arm.urdf -o first.toml",
        "init arm.csv -o standard.toml",
        "init arm.csv -o modified.toml --convention modified",
    )),
    "effects": Golden(CAMPAIGN, ("effects", "effects placed.toml --json")),
    "study": Golden(CAMPAIGN, (
        "study study -o results --set replicates=3 -q --jobs 1",
        "study study -o results --set replicates=3 -q --jobs 1",
    )),
    "help": Golden((), ("--help", *(f"{verb} --help" for verb in (
        "init", "effects", "design", "simulate", "import", "identify", "diagnose", "next",
        "compensate", "export", "compare", "study", "demo"
    )))),
    # The front door
    "door": Golden((), (door.names, door.published)),
    "told": Golden((), (door.told,)),
    "door_model": Golden(CAMPAIGN, (door.model, door.compensated)),
    "door_fit": Golden(CAMPAIGN, (
        door.identified, door.built_in_python, door.compared, door.planned, door.diagnosed,
    ), engine=True),
    # Measured arms
    "real_ur5": Golden(("experiment_design/real_arms/ur5.toml",), (
        door.thinned_ur5,
        "identify ur5.toml grid.csv --test random.csv -o result.json -q",
        "diagnose ur5.toml grid.csv -o diagnosis.json -q",
    ), engine=True, needs="ELASTOCAL_DATASETS"),
    # What is refused
    "mistakes_table": Golden(CAMPAIGN, mistakes.TABLE),
    "mistakes_cell": Golden(CAMPAIGN, mistakes.CELL),
    "mistakes_options": Golden(CAMPAIGN, mistakes.OPTIONS),
    "mistakes_gone": Golden(CAMPAIGN, mistakes.GONE),
    "mistakes_design": Golden(CAMPAIGN, mistakes_design.TABLE),
}  # fmt: skip
