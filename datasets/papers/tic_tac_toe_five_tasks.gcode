; after figures 11 and 12 of Hoelzle 2009: tic-tac-toe in which every material performs all five tasks
; four lines, a stroke with corners through a row and a square "O" in material A; X and a round O in material B, whose
; third mark is a triangle: Corner needs a run that turns, which neither a straight stroke nor a circle does
G21
G90
M83
T0
G0 X40 Y0 Z0.3 F900
G1 X40 Y120 E120 F480
G0 X80 Y0 F900
G1 X80 Y120 E120 F480
G0 X0 Y40 F900
G1 X120 Y40 E120 F480
G0 X0 Y80 F900
G1 X120 Y80 E120 F480
; a square O
G0 X48 Y48 F900
G1 X72 Y48 E24 F480
G1 X72 Y72 E24
G1 X48 Y72 E24
G1 X48 Y48 E24
T1
G4 P2000
; an X of two strokes
G0 X8 Y8 F900
G1 X32 Y32 E33.94 F480
G0 X8 Y32 F900
G1 X32 Y8 E33.94 F480
; a round O: centre by I and J
G0 X112 Y100 F900
G3 X112 Y100 I-12 J0 E75.40 F480
; a triangle
G0 X8 Y88 F900
G1 X32 Y88 E24 F480
G1 X20 Y112 E26.83
G1 X8 Y88 E26.83
G0 X0 Y0 F900
