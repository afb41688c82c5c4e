// The report's style sheet.
#pragma once

namespace orthonav::evaluate {

inline constexpr const char* kStyle = R"css(
:root { --ink:#1d2530; --soft:#5d6b7c; --line:#dde3ea; --paper:#ffffff; --page:#f3f5f8;
  --fusion:#0b62d6; --truth:#111111; --vio:#e07b00; --fix:#12853c; --wrong:#d3212c; --other:#a3adb9; }
* { box-sizing:border-box; }
body { margin:0; background:var(--page); color:var(--ink); font:16px/1.5 system-ui,"Segoe UI",Roboto,"DejaVu Sans",sans-serif; }
main { max-width:980px; margin:0 auto; padding:20px 16px 60px; }
header h1 { font-size:1.6rem; margin:8px 0 2px; letter-spacing:-.01em; }
header p { margin:0 0 18px; color:var(--soft); }
section { background:var(--paper); border:1px solid var(--line); border-radius:10px; padding:16px 18px; margin:16px 0; }
h2 { font-size:1.12rem; margin:0 0 8px; }
h3 { font-size:.95rem; margin:14px 0 6px; }
p.caption { color:var(--soft); font-size:.86rem; margin:6px 0 2px; }
.tiles { display:grid; grid-template-columns:repeat(auto-fit,minmax(148px,1fr)); gap:12px; margin:16px 0; }
.tile { background:var(--paper); border:1px solid var(--line); border-radius:10px; padding:12px 14px; }
.tile b { display:block; font-size:1.65rem; line-height:1.2; font-variant-numeric:tabular-nums; font-weight:650; }
.tile small { font-size:.95rem; font-weight:400; color:var(--soft); }
.tile span { display:block; color:var(--soft); font-size:.84rem; line-height:1.35; }
.tile.first { border-left:5px solid var(--fusion); }
.notes { border-left:5px solid var(--vio); }
.notes ul { margin:4px 0; padding-left:20px; }
.scroll { overflow-x:auto; }
table { border-collapse:collapse; width:100%; font-variant-numeric:tabular-nums; font-size:.92rem; }
th,td { text-align:right; padding:6px 8px; border-bottom:1px solid var(--line); white-space:nowrap; }
th:first-child,td:first-child { text-align:left; white-space:normal; }
thead th { color:var(--soft); font-weight:600; font-size:.82rem; vertical-align:bottom; }
td.strong { font-weight:700; }
td.paper,th.paper { color:var(--soft); background:#f8f9fb; }
tbody tr:last-child td { border-bottom:0; }
svg { display:block; width:100%; height:auto; }
svg text { font-family:inherit; }
.chart .grid { stroke:#e6eaef; fill:none; } .chart .axis { stroke:#8b97a5; fill:none; }
.chart .tick { font-size:11.5px; fill:var(--soft); } .chart .label { font-size:12.5px; fill:var(--ink); }
.chart .line { fill:none; stroke-width:1.8; stroke-linejoin:round; }
.chart .band { stroke:none; opacity:.16; } .chart .dots { fill:none; stroke-linecap:round; }
.chart .upright { stroke:var(--soft); stroke-dasharray:4 3; fill:none; } .chart .mark { font-size:11px; fill:var(--soft); }
.line.fusion { stroke:var(--fusion); } .band.fusion,.key.fusion,.bar.fusion { fill:var(--fusion); }
.line.vio { stroke:var(--vio); stroke-width:1.3; } .key.vio { fill:var(--vio); }
.dots.fix { stroke:var(--fix); opacity:.55; } .key.fix,.bar.fix { fill:var(--fix); }
.dots.wrong { stroke:var(--wrong); } .key.wrong,.bar.wrong { fill:var(--wrong); }
.bar.other,.key.other { fill:var(--other); } .key.band { fill:var(--fusion); opacity:.25; }
.map { border-radius:6px; background:#e9ecef; }
.map .track { fill:none; stroke-linejoin:round; stroke-linecap:round; }
.map .casing { stroke:#fff; stroke-width:8; opacity:.85; } .map .truth { stroke:var(--truth); stroke-width:4.5; }
.map .vio { stroke:var(--vio); stroke-width:2.6; } .map .fusion { stroke:var(--fusion); stroke-width:2.8; }
.map .fix { stroke:var(--fix); stroke-width:8; stroke-linecap:round; fill:none; opacity:.75; }
.map .wrong { stroke:var(--wrong); stroke-width:4; fill:none; } .map .astray { stroke:var(--wrong); stroke-width:1.2; opacity:.6; }
.map .nomap { fill:#eef1f4; }
.map .scale rect { fill:#fff; opacity:.88; } .map .scale path { stroke:#111; stroke-width:2; fill:none; } .map .scale text { font-size:18px; }
.map circle.place { fill:#fff; stroke:#111; stroke-width:3; }
.map text.place { font-size:21px; font-weight:600; paint-order:stroke; stroke:#fff; stroke-width:5px; stroke-linejoin:round; }
.legend { display:flex; flex-wrap:wrap; gap:4px 18px; font-size:.88rem; margin:8px 0 0; color:var(--soft); }
.legend i { display:inline-block; width:20px; height:4px; border-radius:2px; margin-right:6px; vertical-align:middle; }
.legend i.dot { width:9px; height:9px; border-radius:50%; }
.pair { display:grid; grid-template-columns:1fr 1fr; gap:8px; margin:4px 0 14px; break-inside:avoid; }
.pair img { width:100%; display:block; border-radius:6px; }
.state { display:inline-block; padding:0 8px; border-radius:9px; color:#fff; font-size:.8rem; }
.state.ok { background:var(--fix); } .state.starting { background:var(--soft); } .state.degraded { background:var(--vio); } .state.failed { background:var(--wrong); }
details { margin:6px 0; } summary { cursor:pointer; } details table { font-size:.84rem; }
footer { color:var(--soft); font-size:.84rem; margin-top:24px; }
@media (max-width:560px) { body { font-size:15px; } section { padding:12px; } .pair { grid-template-columns:1fr; } th,td { padding:5px 6px; } }
@media print { body { background:#fff; font-size:11pt; } main { max-width:none; padding:0; } section,.tile { break-inside:avoid; border-color:#bbb; }
  details>*:not(summary) { display:block; } * { -webkit-print-color-adjust:exact; print-color-adjust:exact; } }
)css";

}  // namespace orthonav::evaluate
