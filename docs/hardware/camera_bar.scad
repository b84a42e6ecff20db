// A bar that holds two cameras side by side, looking along -z of the print, and one tripod nut.
// Print it flat, front face down, 0.2 mm layers, 4 walls, 40 % infill; PETG or PLA. All lengths in millimetres.
//   openscad -D 'camera="gs"' -o camera_bar_gs.stl camera_bar.scad
use <cameras.scad>

camera = "module";    // a name of cameras.scad
baseline = 75;        // lens to lens: the rig file's T_rig_camera is measured, this only has to stay as it is
bar_z = 8;            // a stiff bar is what the calibration lives on: do not make it thinner
stand = 3;            // pillars: the board's parts need room behind it
nut = [12.8, 5.6];    // 1/4"-20 UNC: width across corners, height
thread = 6.6;
boss = [20, 20, 17];  // about the nut, which is thicker than the bar

board = board_of(camera)[1];
bore = board_of(camera)[4];
bar = [baseline + board.x + 20, board.y + 10, bar_z];

$fn = 48;

module seat() {
  // The window, and below it the room for the ribbon cable; it runs into a round window, so that no sliver is left between.
  translate([0, 0, -1]) linear_extrude(bar.z + 2) window(camera);
  translate([-9, -bar.y / 2 - 1, 2]) cube([18, board_of(camera)[6] ? 13 : 8, bar.z]);
  for (screw = screws_of(camera)) translate([screw.x, screw.y, 1.2]) cylinder(d = bore, h = bar.z + stand);
}

module pillars() {
  for (screw = screws_of(camera)) translate([screw.x, screw.y, bar.z - 0.01]) cylinder(d = bore + 2.7, h = stand);
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
