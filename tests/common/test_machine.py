"""Temperature, throttling and disk of a computer, read below a root of ours."""

from pathlib import Path

from common.machine import ROOT, Machine

TRIPS = {
    "trip_point_0_type": "active",
    "trip_point_0_temp": "40000",
    "trip_point_1_type": "critical",
    "trip_point_1_temp": "100000",
}


def _zone(root: Path, number: int, kind: str, milli: str, **files: str) -> None:
    zone = root / f"sys/class/thermal/thermal_zone{number}"
    zone.mkdir(parents=True)
    for name, text in ({"type": kind, "temp": milli} | files).items():
        (zone / name).write_text(text + "\n")


def test_a_pi_is_hot_from_where_it_lowers_its_clock(tmp_path: Path) -> None:
    _zone(tmp_path, 0, "cpu-thermal", "81300", trip_point_0_type="critical", trip_point_0_temp="110000")
    flags = tmp_path / "sys/devices/platform/soc/soc:firmware/get_throttled"
    flags.parent.mkdir(parents=True)
    flags.write_text("50005\n")  # now and since the start: weak supply, throttled
    (tmp_path / "disk_free_mb").write_text("123.5\n")
    metrics = Machine(tmp_path, {ROOT: str(tmp_path)}).metrics()
    assert metrics == {
        "temperature_c": 81.3,
        "temperature_limit_c": 80.0,
        "throttled": 5.0,
        "disk_free_mb": 123.5,
    }


def test_of_another_computer_the_zone_nearest_to_its_trip_point_counts(tmp_path: Path) -> None:
    _zone(tmp_path, 0, "acpitz", "27800")
    _zone(tmp_path, 1, "x86_pkg_temp", "91000", **TRIPS)
    _zone(tmp_path, 2, "wifi", "60000", **TRIPS)
    _zone(tmp_path, 3, "odd", "not known", **TRIPS)
    metrics = Machine(tmp_path, {ROOT: str(tmp_path)}).metrics()
    assert (metrics["temperature_c"], metrics["temperature_limit_c"]) == (91.0, 95.0)


def test_what_is_not_there_is_not_reported(tmp_path: Path) -> None:
    metrics = Machine(tmp_path, {ROOT: str(tmp_path)}).metrics()
    assert set(metrics) == {"disk_free_mb"}
    assert metrics["disk_free_mb"] > 0.0  # of the disk that the folder really is on
    (tmp_path / "disk_free_mb").write_text("")  # as it is while somebody writes it
    assert Machine(tmp_path, {ROOT: str(tmp_path)}).metrics()["disk_free_mb"] > 0.0
    assert Machine(tmp_path / "gone", {ROOT: str(tmp_path)}).disk_free_mb() is None


def test_a_pi_5_has_the_flags_of_its_firmware_elsewhere(tmp_path: Path) -> None:
    flags = tmp_path / "sys/devices/platform/soc@107c000000/soc@107c000000:firmware/get_throttled"
    flags.parent.mkdir(parents=True)
    flags.write_text("80008\n")
    assert Machine(tmp_path, {ROOT: str(tmp_path)}).metrics()["throttled"] == 8.0


def test_a_kernel_without_these_flags_reports_only_a_weak_supply(tmp_path: Path) -> None:
    for number, (name, alarm) in enumerate([("cpu_thermal", "0"), ("rpi_volt", "1")]):
        sensor = tmp_path / f"sys/class/hwmon/hwmon{number}"
        sensor.mkdir(parents=True)
        (sensor / "name").write_text(name + "\n")
        (sensor / "in0_lcrit_alarm").write_text(alarm + "\n")
    assert Machine(tmp_path, {ROOT: str(tmp_path)}).metrics()["throttled"] == 1.0
