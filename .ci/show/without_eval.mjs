// Print MuJoCo's JavaScript with both places that make code of text replaced, so that a page may forbid `eval`.
import { readFileSync } from "node:fs";

const CALL = {
  from: "let [args, invokerFnBody] = createJsInvoker(argTypes, isClassMethodFunc, returns, isAsync);",
  to: "var invokerFn = new Function(...args, invokerFnBody)(...closureArgs);",
  instead: `
      var invokerFn = function (...given) {
        checkArgCount(given.length, minArgs, expectedArgCount, humanName, throwBindingError);
        var destructors = needsDestructorStack ? [] : null;
        var wired = isClassMethodFunc ? [argTypes[1]['toWireType'](destructors, this)] : [];
        for (var i = 0; i < expectedArgCount; ++i) wired.push(argTypes[i + 2]['toWireType'](destructors, given[i]));
        var rv = cppInvokerFunc(cppTargetFunc, ...wired);
        if (needsDestructorStack) runDestructors(destructors);
        else {
          var first = isClassMethodFunc ? 1 : 2;
          for (var i = first; i < argTypes.length; ++i) {
            if (argTypes[i].destructorFunction !== null) argTypes[i].destructorFunction(wired[i - first]);
          }
        }
        if (returns) return argTypes[0]['fromWireType'](rv);
      };`,
};
const CALL_BACK = {
  from: "var functionBody =\n        `return function (obj, func, destructorsRef, args) {\\n`;",
  to: "var invokerFunction = new Function(...params, functionBody)(...args);",
  instead: `
      var invokerFunction = function (obj, func, destructorsRef, args) {
        var given = types.map((type) => {
          var value = type.readValueFromPointer(args);
          args += type.argPackAdvance;
          return value;
        });
        var rv = kind === 1 ? new func(...given) : kind === 0 ? func.call(obj, ...given) : func.call(...given);
        if (!retType.isVoid) return emval_returnValue(retType, destructorsRef, rv);
      };`,
};

let text = readFileSync("node_modules/@mujoco/mujoco/mujoco.js", "utf8");
for (const { from, to, instead } of [CALL, CALL_BACK]) {
  const start = text.indexOf(from), end = text.indexOf(to, start);
  if (start < 0 || end < 0 || text.indexOf(from, start + 1) >= 0) throw new Error(`mujoco.js has changed, at: ${from}`);
  text = text.slice(0, start) + instead + text.slice(end + to.length);
}
if (/\beval\(|new Function\b/.test(text)) throw new Error("mujoco.js makes code of text in another place, too");
process.stdout.write(text);
