// The comparison of the selected runs: their traces over environment steps, and their designs in parallel coordinates.

import { init } from "./vendor/charts.js";
import { number, steps } from "./runs-table.js";

const COLOURS = ["#0f7dc2", "#e07b00", "#17a673", "#c2459b", "#8a6be0", "#c9a400", "#5aa9e6", "#d0342c", "#7a828e"];
const RETURNS = ["#3b4cc0", "#2a9d8f", "#d9a92f", "#d1495b"];
const RETURNS_DARK = ["#8a97f5", "#35b8a8", "#e9c46a", "#f0788a"];
const FONT = "system-ui, -apple-system, 'Segoe UI', Roboto, 'Helvetica Neue', sans-serif";
const WORDS = { success: "success on Hw-Phy [%]", episode_return: "return on Hw-Phy" };

const css = (name) => getComputedStyle(document.documentElement).getPropertyValue(name).trim();

function look() {
  return {
    textStyle: { fontFamily: FONT, color: css("--text") }, animation: false,
    tooltip: { renderMode: "richText", backgroundColor: css("--ground"), borderColor: css("--line"), textStyle: { color: css("--text"), fontSize: 12 } },
  };
}

function axis(name, extra) {
  return {
    type: "value", name, nameLocation: "middle", nameGap: 28, nameTextStyle: { color: css("--faint") },
    axisLine: { lineStyle: { color: css("--faint") } }, axisLabel: { color: css("--faint"), hideOverlap: true },
    splitLine: { lineStyle: { color: css("--line") } }, ...extra,
  };
}

// --- traces ----------------------------------------------------------------------------------------------------------

export class Traces {
  constructor(element) {
    this.chart = init(element);
  }

  draw({ traces, means }, { measure, single }) {
    const several = new Set(traces.map((t) => t.task)).size > 1;
    const group = (t) => (several ? `${t.task} · ${t.method}` : t.method);
    const groups = [...new Set(traces.map(group))];
    const colour = (t) => COLOURS[groups.indexOf(group(t)) % COLOURS.length];
    const meant = new Map(means.map((m) => [group(m), m]));
    const series = [];
    for (const mean of means) {
      const curve = mean[measure], at = (values) => mean.env_steps.map((x, i) => [x, values[i]]);
      const band = { type: "line", name: group(mean), stack: `band ${group(mean)}`, stackStrategy: "all", symbol: "none", silent: true, lineStyle: { opacity: 0 }, color: colour(mean) };
      series.push({ ...band, data: at(curve.low) });
      series.push({ ...band, data: at(curve.high.map((high, i) => high - curve.low[i])), areaStyle: { opacity: 0.2, color: colour(mean) } });
    }
    for (const t of traces) {
      const thick = !meant.has(group(t));
      if (!single && !thick) continue;
      series.push({
        type: "line", id: `run ${t.run}`, name: group(t), data: t.env_steps.map((x, i) => [x, t[measure][i], t.run]), color: colour(t), triggerLineEvent: true,
        symbol: t.env_steps.length === 1 ? "circle" : "none", lineStyle: { width: thick ? 1.6 : 1, opacity: thick ? 0.9 : traces.length > 12 ? 0.25 : 0.45 }, z: 3,
      });
    }
    for (const mean of means) {
      series.push({ type: "line", id: `mean ${group(mean)}`, name: group(mean), data: mean.env_steps.map((x, i) => [x, mean[measure].mean[i], mean[measure].low[i], mean[measure].high[i]]), color: colour(mean), symbol: "none", lineStyle: { width: 2.5 }, z: 4 });
    }
    const named = (name) => {
      const count = traces.filter((t) => group(t) === name).length;
      return `${name} (${count} ${count === 1 ? "run" : "runs"})`;
    };
    const format = measure === "success" ? percent : number;
    this.chart.setOption({
      ...look(), color: groups.map((_, i) => COLOURS[i % COLOURS.length]),
      legend: { type: "scroll", top: 4, left: 8, right: 8, icon: "roundRect", itemWidth: 14, itemHeight: 4, data: groups, formatter: named, textStyle: { color: css("--text") }, pageTextStyle: { color: css("--faint") } },
      grid: { left: 58, right: 30, top: 36, bottom: 62 },
      xAxis: axis("environment steps", { axisLabel: { color: css("--faint"), hideOverlap: true, formatter: steps }, splitLine: { show: false } }),
      yAxis: axis(WORDS[measure], { nameGap: 40, ...(measure === "success" ? { min: 0, max: 1 } : { scale: true }), axisLabel: { color: css("--faint"), formatter: (v) => String(measure === "success" ? Math.round(100 * v) : v).replace("-", "−") } }),
      tooltip: {
        ...look().tooltip, trigger: "axis",
        formatter: (points) => {
          const told = points.filter((p) => p.seriesId.startsWith("mean ")).map((p) => `${p.marker}${p.seriesName}  ${format(p.value[1])}  [${format(p.value[2])}, ${format(p.value[3])}]`);
          const runs = points.filter((p) => p.seriesId.startsWith("run "));
          if (!told.length || runs.length <= 6) told.push(...runs.slice(0, 8).map((p) => `${p.marker}${p.value[2]}  ${format(p.value[1])}`));
          return [`${steps(Math.round(points[0].axisValue))} steps`, ...told].join("\n");
        },
      },
      series,
    }, true);
  }
}

// --- parallel coordinates --------------------------------------------------------------------------------------------

// The unit in which people think of a parameter, as in the viewer: degrees, and centimetres for what is below a metre.
function unitOf(p) {
  if (p.unit === "rad") return { name: "°", factor: 180 / Math.PI };
  if (p.unit === "m") return p.hard_hi < 1 ? { name: "cm", factor: 100 } : { name: "m", factor: 1 };
  return { name: p.unit, factor: 1 };
}

export class Designs {
  // `onSee` is called with a design under the pointer or null, `onOpen` with one that was clicked, `onBrush` with counts.
  constructor(element, { onSee, onOpen, onBrush }) {
    this.chart = init(element);
    this.designs = [];
    const of = (event) => this.designs[event.dataIndex];
    this.chart.on("click", "series.parallel", (event) => of(event) && onOpen(of(event)));
    this.chart.on("mouseover", "series.parallel", (event) => onSee(of(event) ?? null));
    this.chart.on("mouseout", "series.parallel", () => onSee(null));
    this.chart.on("axisareaselected", () => onBrush(this.brushed().length, this.designs.length));
  }

  brushed() {
    const series = this.chart.getModel().getSeriesByIndex(0);
    return series ? series.getRawIndicesByActiveState("active") : [];
  }

  // Return how many runs are left out because their design has other parameters than that of the first.
  draw({ traces }, { which }) {
    const named = (t) => t.parameters.map((p) => `${p.name} ${p.unit}`).join();
    const drawn = traces.filter((t) => t.task === traces[0].task && named(t) === named(traces[0]));
    const parameters = drawn[0]?.parameters ?? [];
    const units = parameters.map(unitOf);
    this.designs = drawn.flatMap((t) => {
      const all = t.iteration.map((iteration, i) => ({ run: t.run, method: t.method, iteration, phi: t.phi[i], success: t.success[i], return: t.episode_return[i] }));
      if (which === "all") return all;
      return all.length ? [all.reduce((best, d) => (d.success > best.success || (d.success === best.success && d.return > best.return) ? d : best))] : [];
    });
    const returns = this.designs.map((d) => d.return);
    const [low, high] = [Math.min(...returns), Math.max(...returns)];
    const dimension = parameters.length + 1;
    const vertical = (name, dim, extra) => ({ dim, name, ...extra });
    const shown = (value) => number(value);
    this.chart.setOption({
      ...look(), tooltip: { show: false },
      parallel: {
        left: 30, right: 104, top: 44, bottom: 34,
        parallelAxisDefault: {
          type: "value", scale: true, realtime: true, nameLocation: "end", nameGap: 10, nameTextStyle: { color: css("--text"), fontSize: 10.5, lineHeight: 13 }, nameTruncate: { maxWidth: 90 },
          axisLine: { lineStyle: { color: css("--faint") } }, axisTick: { show: false }, axisLabel: { color: css("--text"), textBorderColor: css("--ground"), textBorderWidth: 3, fontSize: 10, hideOverlap: true, formatter: (v) => String(+v.toPrecision(3)).replace("-", "−") },
          splitLine: { show: false }, areaSelectStyle: { width: 18, color: css("--accent"), borderColor: css("--accent"), opacity: 0.3 },
        },
      },
      parallelAxis: [
        ...parameters.map((p, i) => vertical(p.name.replaceAll("_", " ") + (units[i].name ? `\n[${units[i].name}]` : ""), i)),
        vertical("success\n[%]", parameters.length, { min: 0, max: 100, scale: false }),
        vertical("return", dimension),
      ],
      visualMap: {
        type: "continuous", dimension, min: low, max: high > low ? high : low + 1, right: 4, top: "middle", itemHeight: 90, itemWidth: 10, calculable: false, hoverLink: false,
        inRange: { color: document.documentElement.dataset.theme === "dark" ? RETURNS_DARK : RETURNS }, text: [`return\n${shown(high)}`, shown(low)], textStyle: { color: css("--faint"), fontSize: 11 }, show: this.designs.length > 0,
      },
      series: [{
        type: "parallel", data: this.designs.map((d) => [...d.phi.map((v, i) => v * units[i].factor), 100 * d.success, d.return]),
        lineStyle: { width: 1.5, opacity: this.designs.length > 200 ? 0.35 : 0.6 }, inactiveOpacity: 0.04, activeOpacity: 0.9, progressive: 0,
        emphasis: { lineStyle: { width: 3, opacity: 1 } },
      }],
    }, true);
    return traces.length - drawn.length;
  }
}
