// What a wrist device is built on: camera and laser 30 mm apart, four LEDs about the lens, a strap, an IMU.
// It sits under the wrist, the camera looks along the palm at the fingers. All lengths in millimetres.
//   openscad -D 'camera="ov9281_32"' -o wrist_bracket_32.stl wrist_bracket.scad
use <cameras.scad>

camera = "ov9281";    // a name of cameras.scad
apart = 30;           // lens to laser (Digits, UIST 2012); measured by `calibrate wrist laser-plane`
laser = 8.2;          // barrel of a line-laser module
led = 5.2;            // 5 mm LEDs beside the board
strap = [26, 3.5];
imu = [20.3, 12.7];   // holes of a small IMU board, M2
imu_bore = 1.7;

board = board_of(camera)[1];
bore = board_of(camera)[4];
led_x = board.x / 2 + 5.5;                               // beyond the board's edge
base = [max(52, 2 * led_x + 16), 46, 4];                 // on the forearm, between two slits for a strap of 25 mm
lens_z = base.z + board.y / 2 + 2;                       // the middle of the board above the base's underside
wall = [base.x, 4, lens_z + apart + 8];                  // what camera, laser and LEDs look out of

$fn = 48;

difference() {
  union() {
    translate([-base.x / 2, 0, 0]) cube(base);
    translate([-wall.x / 2, base.y - wall.y, 0]) cube(wall);
    // Two ribs keep the angle between wall and base, on which the calibration lives.
    for (side = [-1, 1]) translate([side * (base.x / 2 - 2) - 2, 0, 0])
      rotate([90, 0, 90]) linear_extrude(4) polygon([[base.y - 26, 3], [base.y - 2, 3], [base.y - 2, 28]]);
  }
  // Looking from in front: the board's upper edge is up.
  translate([0, base.y + 1, lens_z]) rotate([90, 0, 0]) {
    linear_extrude(wall.y + 2) window(camera);
    for (screw = screws_of(camera)) translate([screw.x, screw.y, 0]) cylinder(d = bore, h = wall.y + 2);
    for (x = [-1, 1], y = [-1, 1]) translate([x * led_x, y * 9, 0]) cylinder(d = led, h = wall.y + 2);
  }
  translate([0, base.y + 1, lens_z + apart]) rotate([90, 0, 0]) cylinder(d = laser, h = wall.y + 2);
  for (y = [5, base.y - 11]) translate([-strap.x / 2, y - strap.y / 2, -1]) cube([strap.x, strap.y, base.z + 2]);
  for (x = [-1, 1], y = [-1, 1])
    translate([x * imu.x / 2, 20 + y * imu.y / 2, -1]) cylinder(d = imu_bore, h = base.z + 2);
}
