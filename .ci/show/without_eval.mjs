// Print MuJoCo's JavaScript with the one function that makes code of text replaced, so that a page may forbid `eval`.
import { readFileSync } from "node:fs";

const ONLY = "var invokerFn = new Function(...args, invokerFnBody)(...closureArgs);";
const BEFORE = "let [args, invokerFnBody] = createJsInvoker(argTypes, isClassMethodFunc, returns, isAsync);";
const INSTEAD = `
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
      };`;

let text = readFileSync("node_modules/@mujoco/mujoco/mujoco.js", "utf8");
for (const [words, other] of [[BEFORE, ""], [ONLY, INSTEAD]]) {
  if (text.split(words).length !== 2) throw new Error(`mujoco.js has changed; it must hold once: ${words}`);
  text = text.replace(words, () => other);
}
process.stdout.write(text);
