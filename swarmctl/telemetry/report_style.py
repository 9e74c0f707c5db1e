"""Style sheet of the report: light colours, one column on a phone, two or three on a screen."""

STYLE = """
:root { color-scheme: light }
* { box-sizing: border-box }
body {
  font: 14px/1.45 system-ui, -apple-system, "Segoe UI", Roboto, sans-serif;
  color: #1e293b; background: #f1f5f9; margin: 0;
}
main { max-width: 1360px; margin: 0 auto; padding: 20px 16px 48px }
h1 { font-size: 22px; margin: 0 0 2px; overflow-wrap: anywhere }
h2 { font-size: 16px; margin: 26px 0 10px }
.sub { color: #64748b; margin: 0 0 14px }
.badge {
  display: inline-block; border-radius: 99px; padding: 2px 12px; margin-left: 8px;
  font-weight: 600; font-size: 13px; color: #fff; vertical-align: 3px;
}
.completed { background: #15803d }
.failed { background: #dc2626 }
.interrupted { background: #b45309 }
.cards { display: grid; grid-template-columns: repeat(auto-fit, minmax(min(100%, 400px), 1fr)); gap: 12px }
.cards.big { grid-template-columns: repeat(auto-fit, minmax(min(100%, 520px), 1fr)) }
figure, .card {
  background: #fff; border: 1px solid #e2e8f0; border-radius: 10px; margin: 0; padding: 10px 12px; min-width: 0;
}
figcaption { font-weight: 600; font-size: 13px; margin-bottom: 4px }
svg { width: 100%; height: auto; display: block }
path { fill: none }
.grid { stroke: #e2e8f0 }
.axis { stroke: #94a3b8 }
.tick { font-size: 11px; fill: #64748b }
.band { fill: #f0fdf4 }
.obstacle { fill: #fee2e2; stroke: #ef4444 }
.keepout { fill: #fee2e2; fill-opacity: .45; stroke: #ef4444; stroke-dasharray: 4 3 }
.legend { display: flex; flex-wrap: wrap; gap: 2px 14px; font-size: 12px; color: #475569; margin-top: 2px }
.legend i { display: inline-block; width: 18px; margin-right: 5px; vertical-align: 4px }
table { border-collapse: collapse; width: 100%; font-variant-numeric: tabular-nums }
td, th { padding: 4px 8px; text-align: left; border-bottom: 1px solid #eef2f7; vertical-align: top }
th { color: #64748b; font-weight: 600; font-size: 12px }
td.n, th.n { text-align: right }
tr:last-child td { border: 0 }
table + table { margin-top: 10px }
.ok { color: #15803d; font-weight: 600 }
.bad { color: #dc2626; font-weight: 600 }
.wide { overflow-x: auto }
.scroll { overflow: auto; max-height: 420px }
ul.violations {
  margin: 0 0 12px; padding: 10px 14px 10px 30px; border-radius: 10px;
  background: #fef2f2; border: 1px solid #fecaca; color: #991b1b;
}
pre {
  font: 12px/1.4 ui-monospace, Menlo, Consolas, monospace; margin: 8px 0 0;
  white-space: pre-wrap; overflow-wrap: anywhere;
}
summary { cursor: pointer; font-weight: 600 }
nav { display: flex; flex-wrap: wrap; gap: 4px 14px; margin: 0 0 14px }
a { color: #2563eb; text-decoration: none }
.tiles { display: grid; grid-template-columns: repeat(auto-fit, minmax(150px, 1fr)); gap: 12px; margin-bottom: 12px }
.tiles b { display: block; font-size: 24px; line-height: 1.2; font-variant-numeric: tabular-nums }
.tiles span { color: #64748b; font-size: 12px }
th.group { padding-top: 16px; font-size: 13px; color: #1e293b }
td.note { min-width: 220px; max-width: 420px; color: #475569; font-size: 13px }
.panels { display: grid; grid-template-columns: repeat(auto-fit, minmax(min(100%, 480px), 1fr)); gap: 4px 12px }
.panels figure { border: 0; padding: 0 }
.panels figcaption { font-weight: 400; color: #475569; margin: 0 }
.cards + .cards { margin-top: 12px }
.cards.halves { grid-template-columns: repeat(auto-fill, minmax(min(100%, 520px), 1fr)) }
.cards.small .tick { font-size: 13px }
.prose p { max-width: 900px; margin: 6px 0 }
.prose li { max-width: 880px }
.dot { display: inline-block; width: 10px; height: 10px; border-radius: 50%; margin-right: 7px }
"""
