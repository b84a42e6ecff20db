// What a wrist device is built on: camera and laser 30 mm apart, four LEDs about the lens, a strap, an IMU.
// It sits under the wrist, the camera looks along the palm at the fingers. All lengths in millimetres.

apart = 30;           // lens to laser (Digits, UIST 2012); measured by `calibrate wrist laser-plane`
base = [52, 46, 4];   // on the forearm, between two slits for a strap of 25 mm
wall = [52, 4, 56];   // what camera, laser and LEDs look out of
holes = [21, 12.5];   // M2, camera module 1, 2, 3
screw = 1.7;
window = [13, 15];
lens_z = 18;          // lens above the base
laser = 8.2;          // barrel of a line-laser module
led = 5.2;            // 5 mm LEDs, 9 mm beside and above the lens
strap = [26, 3.5];
imu = [20.3, 12.7];   // holes of a small IMU board, M2

$fn = 48;

difference() {
  union() {
    translate([-base.x / 2, 0, 0]) cube(base);
    translate([-wall.x / 2, base.y - wall.y, 0]) cube(wall);
    // Two ribs keep the angle between wall and base, on which the calibration lives.
    for (side = [-1, 1]) translate([side * (base.x / 2 - 2) - 2, 0, 0])
      rotate([90, 0, 90]) linear_extrude(4) polygon([[base.y - 26, 3], [base.y - 2, 3], [base.y - 2, 28]]);
  }
  translate([0, base.y - wall.y - 1, lens_z]) rotate([-90, 0, 0]) {
    linear_extrude(wall.y + 2) square(window, center = true);
    for (x = [-1, 1], y = [-1, 1]) {
      translate([x * holes.x / 2, y * holes.y / 2, 0]) cylinder(d = screw, h = wall.y + 2);
      translate([x * 18, y * 9, 0]) cylinder(d = led, h = wall.y + 2);
    }
  }
  translate([0, base.y - wall.y - 1, lens_z + apart]) rotate([-90, 0, 0]) cylinder(d = laser, h = wall.y + 2);
  for (y = [5, base.y - 11]) translate([-strap.x / 2, y - strap.y / 2, -1]) cube([strap.x, strap.y, base.z + 2]);
  for (x = [-1, 1], y = [-1, 1]) translate([x * imu.x / 2, 20 + y * imu.y / 2, -1]) cylinder(d = screw, h = base.z + 2);
}
