// The camera boards that our holders fit: camera = "module" | "gs" | "ov9281" | "ov9281_32". All lengths in millimetres.
//
//   module     Raspberry Pi Camera Module 1, 2, 3: 25 x 24, M2 at 21 x 12.5, the upper pair 2 below the edge
//   gs         Raspberry Pi Global Shutter Camera: 38 x 38, M2.5 at 30 x 30, CS mount 36 in diameter (without its tripod block)
//   ov9281     OV9281 on a board with outline and holes of the Camera Module, under an M12 lens holder of up to 16 x 16
//   ov9281_32  OV9281 on a board of 32 x 32, M2 at 28 x 28, under an M12 lens holder of up to 20 x 20
//
// Boards with an OV9281 differ from maker to maker: measure yours. The last three are drawn from published sizes of such boards.
// Columns: board, holes from centre to centre, upper edge to upper pair, bore in which the screw cuts its thread, window, round?
function boards() = [
  ["module",    [25, 24], [21, 12.5], 2, 1.7, [13, 15],     false],
  ["gs",        [38, 38], [30, 30],   4, 2.1, [36.6, 36.6], true],
  ["ov9281",    [25, 24], [21, 12.5], 2, 1.7, [16.2, 16.2], false],
  ["ov9281_32", [32, 32], [28, 28],   2, 1.7, [20.2, 20.2], false],
];

function board_of(camera) = let (found = [for (one = boards()) if (one[0] == camera) one])
  assert(len(found) == 1, str("camera = \"", camera, "\": there are ", [for (one = boards()) one[0]])) found[0];

// Positions of the four screws; (0, 0) is the middle of the board, +y its upper edge.
function screws_of(camera) = let (one = board_of(camera))
  [for (x = [-1, 1], y = [0, 1]) [x * one[2].x / 2, one[1].y / 2 - one[3] - y * one[2].y]];

// What the lens looks through, around the middle of the board.
module window(camera) {
  size = board_of(camera)[5];
  if (board_of(camera)[6]) circle(d = size.x, $fn = 96); else square(size, center = true);
}
