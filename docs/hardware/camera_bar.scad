// A bar that holds two Raspberry Pi camera modules side by side, looking along -z of the print, and one tripod nut.
// Print it flat, front face down, 0.2 mm layers, 4 walls, 40 % infill; PETG or PLA. All lengths in millimetres.

baseline = 75;        // lens to lens: the rig file's T_rig_camera is measured, this only has to stay as it is
bar = [120, 34, 8];   // a stiff bar is what the calibration lives on: do not make it thinner
board = [25, 24];     // camera module 1, 2 and 3
holes = [21, 12.5];   // M2, of the same modules
hole_edge = 2;        // from the board's upper edge to the upper pair of holes
screw = 1.7;          // M2 x 8 cuts its own thread in this
stand = 3;            // pillars: the board's parts need room behind it
window = [13, 15];    // through which the lens looks; it is in the board's middle line, so lens to lens is `baseline`
nut = [12.8, 5.6];    // 1/4"-20 UNC: width across corners, height
thread = 6.6;
boss = [20, 20, 17];  // about the nut, which is thicker than the bar

$fn = 48;

module seat() {
  // The window, and below it the room for the ribbon cable.
  translate([0, -1, -1]) linear_extrude(bar.z + 2) square(window, center = true);
  translate([0, -bar.y / 2, bar.z / 2 + 2]) cube([18, 14, bar.z], center = true);
  for (x = [-1, 1], y = [0, 1])
    translate([x * holes.x / 2, board.y / 2 - hole_edge - y * holes.y, 1.2]) cylinder(d = screw, h = bar.z + stand);
}

module pillars() {
  for (x = [-1, 1], y = [0, 1])
    translate([x * holes.x / 2, board.y / 2 - hole_edge - y * holes.y, bar.z - 0.01]) cylinder(d = 4.4, h = stand);
}

difference() {
  union() {
    translate([-bar.x / 2, -bar.y / 2, 0]) cube(bar);
    translate([-boss.x / 2, -bar.y / 2, 0]) cube(boss);
    for (side = [-1, 1]) translate([side * baseline / 2, 0, 0]) pillars();
  }
  for (side = [-1, 1]) translate([side * baseline / 2, 0, 0]) seat();
  // The tripod's screw comes from below; the nut slides in from behind.
  translate([0, -bar.y / 2, boss.z / 2]) rotate([-90, 0, 0]) {
    translate([0, 0, -1]) cylinder(d = thread, h = 16);
    translate([0, 0, 6]) rotate([0, 0, 30]) cylinder(d = nut.x, h = nut.y, $fn = 6);
  }
  translate([-nut.x * 0.433, -bar.y / 2 + 6, boss.z / 2]) cube([nut.x * 0.866, nut.y, boss.z]);
}
